"""The common options of every command. They open the bench and the catalog.

This module imports none of numpy, cv2, scipy and sqlalchemy: `rig --help` must start at once.
"""

import json
import os
import sys
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.core.clock import SystemClock
from rig.core.errors import CatalogError, RigError
from rig.core.masking import masked
from rig.core.next_steps import Do, in_words

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from rig.bench import Bench
    from rig.catalog import Catalog
    from rig.config import RigConfig
    from rig.config.catalog_place import CatalogPlace
    from rig.doctor.examination import DoctorContext


@dataclass(frozen=True)
class Settings:
    """The common options, given before or after the command."""

    bench: str | None = None
    config: Path | None = None
    overrides: tuple[str, ...] = ()
    seed: int | None = None
    json: bool = False
    search: bool = True
    """Whether the configuration file in force is used if none is given."""
    opened: list[str] = field(default_factory=list, repr=False, compare=False)
    """Benches that the command has opened."""

    def merged(self, *, overrides: list[str] | None = None, no_color: bool = False, **given: Any) -> "Settings":
        """Return these settings, replaced by those of `CommonOptions` that follow the command."""
        if no_color:
            os.environ["NO_COLOR"] = "1"  # also for the programs that this one starts
        changed = {name: value for name, value in given.items() if value is not None and value is not False}
        return replace(self, overrides=(*self.overrides, *(overrides or ())), **changed)

    def tracing(self, file: Path) -> "Settings":
        """Return these settings, with a trace of the next bench in a file."""
        return self.merged(overrides=[f"trace={json.dumps(str(file))}"])

    def load(self) -> "RigConfig":
        """Return the configuration in force; it is read once."""
        return self._loaded

    @cached_property
    def _loaded(self) -> "RigConfig":
        from rig.config import load_config

        return load_config(self.config, self.overrides, search=self.search)

    def selection(self) -> list[str]:
        """Return the arguments that select the same bench and configuration file for another command."""
        words = [] if self.bench is None else ["--bench", self.bench]
        return words if self.config is None else [*words, "--config", str(self.config)]

    def arguments(self) -> list[str]:
        """Return the arguments that pass these settings to another command, to be shown: without passwords."""
        words = self.selection()
        words += [word for override in self.overrides for word in ("--set", masked(override))]
        words += [] if self.seed is None else ["--seed", str(self.seed)]
        return [*words, "--json"] if self.json else words

    @property
    def bench_name(self) -> str:
        return self.bench or self.load().default_bench

    @property
    def place(self) -> "CatalogPlace":
        """Place of the bench's catalog."""
        return self.load().catalog_place(self.bench_name)

    def open_bench(self, *, tell: bool = True, devices: "Collection[str]" = ("imu", "camera")) -> "Bench":
        """Open the bench and print its notes; with ``tell`` false, the caller prints those on calibration.

        The servo and ``devices`` are opened now, the others when they are first used.
        """
        from rig.bench import open_bench

        self.opened.append(self.bench_name)
        bench = open_bench(self.bench_name, self.load(), seed=self.seed, devices=devices)
        for finding in (*bench.safety.findings, *(bench.calibration_findings if tell else ())):
            print(f"Note: {finding}.", file=sys.stderr)
        if tell and bench.calibration_steps:
            print(in_words(bench.calibration_steps), file=sys.stderr)
        return bench

    @contextmanager
    def open_parts(self, *, default: bool = False) -> "Iterator[DoctorContext]":
        """Yield the bench with its devices closed, for the doctor; ``default`` ignores the configuration file."""
        from rig.config import RigConfig
        from rig.doctor.examination import open_context

        config = RigConfig() if default else self.load()
        file_options = ("--config", str(self.config)) if self.config else ()
        options = tuple(self.selection()) + tuple(word for one in self.overrides for word in ("--set", one))
        name = self.bench or config.default_bench
        with open_context(name, config, seed=self.seed, options=options, file_options=file_options) as context:
            yield context

    def open_catalog(self, *, create: bool = False, read_only: bool = False) -> "Catalog":
        """Open the bench's catalog, but not to enroll."""
        from rig.catalog import Catalog

        place = self.place
        if not create and self.load().catalog.path is None and place.url is None and not place.path.exists():
            raise self._no_catalog(place.path)
        return Catalog.open(place, clock=SystemClock(), create=create, read_only=read_only)

    def _no_catalog(self, path: Path) -> RigError:
        """Return the error that the bench has no catalog; it names the benches that have one."""
        from rig.bench import bench_kind, bench_names

        bench_kind(self.bench_name)  # a misspelt bench has no catalog either
        others = [name for name in bench_names() if self.load().catalog_place(name).database_file.exists()]
        enroll = Do.ENROLL(bench=self.bench_name)
        return CatalogError(
            f"The bench {self.bench_name} has no catalog yet.",
            next_step=(f"Add --bench {others[0]} to use the catalog of that bench, or", enroll) if others else enroll,
            evidence={"folder": str(path), "benches with a catalog": others},
        )

    def say(self, text: str, data: Any) -> None:
        """Print ``text``, or with ``--json`` ``data`` as one line of JSON."""
        if self.json:
            self.print_json(data)
        else:
            print(text, flush=True)

    def print_json(self, value: Any) -> None:
        """Print one line of JSON on stdout, at once; dataclasses are printed as objects."""
        from rig.core.json_form import plain

        print(json.dumps(plain(value), ensure_ascii=False, allow_nan=False, default=str), flush=True)
