"""The common options of every command, and what they open.

Nothing here imports numpy, cv2, scipy or sqlalchemy: `rig --help` must be instant.
"""

import json
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.core.errors import RigError

if TYPE_CHECKING:
    from rig.bench import Bench
    from rig.catalog import Catalog
    from rig.config import RigConfig
    from rig.core.clock import Clock


@dataclass(frozen=True)
class Settings:
    """The common options, as given before and after the subcommand."""

    bench: str | None = None
    config: Path | None = None
    overrides: tuple[str, ...] = ()
    seed: int | None = None
    json: bool = False
    _loaded: dict[str, "RigConfig"] = field(default_factory=dict, repr=False, compare=False)

    def merged(
        self, bench: str | None, config: Path | None, overrides: list[str] | None, seed: int | None, json: bool
    ) -> "Settings":
        """Return these settings with those that follow the subcommand, which win."""
        return replace(
            self,
            bench=bench or self.bench,
            config=config or self.config,
            overrides=(*self.overrides, *(overrides or ())),
            seed=self.seed if seed is None else seed,
            json=json or self.json,
            _loaded={},
        )

    def load(self) -> "RigConfig":
        """Return the configuration in force."""
        if "config" not in self._loaded:
            from rig.config import load_config

            self._loaded["config"] = load_config(self.config, self.overrides)
        return self._loaded["config"]

    def arguments(self) -> list[str]:
        """Return the words that give these settings to another command."""
        words = [] if self.bench is None else ["--bench", self.bench]
        words += [] if self.config is None else ["--config", str(self.config)]
        words += [word for override in self.overrides for word in ("--set", override)]
        return words if self.seed is None else [*words, "--seed", str(self.seed)]

    @property
    def bench_name(self) -> str:
        return self.bench or self.load().default_bench

    def open_bench(self, *, tell: bool = True) -> "Bench":
        """Open the bench and say what a person should know of it, unless the command does so itself (``tell``)."""
        from rig.bench import open_bench

        bench = open_bench(self.bench_name, self.load(), seed=self.seed)
        # Before anything moves.
        for finding in (*bench.safety.findings, *(bench.calibration_findings if tell else ())):
            print(f"Note: {finding}.", file=sys.stderr)
        return bench

    def open_catalog(self, *, clock: "Clock | None" = None, create: bool = False, read_only: bool = False) -> "Catalog":
        """Open the bench's catalog; to add views to it takes the ``clock`` that they were captured by, the bench's."""
        from rig.catalog import Catalog
        from rig.core.clock import SystemClock

        path = self.load().catalog_path(self.bench_name)
        return Catalog.open(path, clock=clock or SystemClock(), create=create, read_only=read_only)

    def catalog_there(self) -> "Catalog | None":
        """Return the bench's catalog, to be read and closed; None where none was made yet."""
        path = self.load().catalog_path(self.bench_name)
        return self.open_catalog(read_only=True) if (path / "catalog.sqlite").exists() else None

    def note(self, action: str, **details: Any) -> None:
        """Write into the log of the bench's catalog, where there is one, what was done with the bench (`rig log`)."""
        path = self.load().catalog_path(self.bench_name)
        if not (path / "catalog.sqlite").exists():
            return
        try:
            with self.open_catalog() as catalog:
                catalog.note(action, **details)
        except RigError as error:  # what was done was done
            print(f"Note: this is not in the log: {error.what}.", file=sys.stderr)

    def say(self, text: str, data: Any) -> None:
        """Print ``text`` for people, or ``data`` as one line of JSON."""
        if self.json:
            self.print_json(data)
        else:
            print(text, flush=True)

    def print_json(self, value: Any) -> None:
        """Print one line of JSON on stdout, at once."""
        print(json.dumps(value, ensure_ascii=False, allow_nan=False, default=str), flush=True)
