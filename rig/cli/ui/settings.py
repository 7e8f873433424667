"""The common options of every command. They open the bench and the catalog.

This module imports none of numpy, cv2, scipy and sqlalchemy: `rig --help` must start at once.
"""

import json
import sys
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.core.errors import RigError
from rig.core.masking import masked
from rig.core.next_steps import Do, in_words

if TYPE_CHECKING:
    from collections.abc import Collection
    from contextlib import AbstractContextManager

    from rig.bench import Bench
    from rig.catalog import Catalog
    from rig.catalog.delivery import Delivery
    from rig.catalog.shared import BackgroundDelivery
    from rig.config import RigConfig
    from rig.core.clock import Clock


@dataclass(frozen=True)
class Settings:
    """The common options, given before or after the command."""

    bench: str | None = None
    config: Path | None = None
    overrides: tuple[str, ...] = ()
    seed: int | None = None
    json: bool = False
    _loaded: dict[str, "RigConfig"] = field(default_factory=dict, repr=False, compare=False)
    opened: list[str] = field(default_factory=list, repr=False, compare=False)
    """Benches that the command has opened."""

    def merged(
        self, bench: str | None, config: Path | None, overrides: list[str] | None, seed: int | None, json: bool
    ) -> "Settings":
        """Return these settings, replaced by those that follow the command."""
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
        """Return the arguments that pass these settings to another command, to be shown: without passwords."""
        words = [] if self.bench is None else ["--bench", self.bench]
        words += [] if self.config is None else ["--config", str(self.config)]
        words += [word for override in self.overrides for word in ("--set", masked(override))]
        words += [] if self.seed is None else ["--seed", str(self.seed)]
        return [*words, "--json"] if self.json else words

    @property
    def bench_name(self) -> str:
        return self.bench or self.load().default_bench

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

    def open_catalog(self, *, clock: "Clock | None" = None, create: bool = False, read_only: bool = False) -> "Catalog":
        """Open the bench's catalog; to add views, pass the ``clock`` of the bench that captures them."""
        from rig.catalog import Catalog
        from rig.core.clock import SystemClock

        place = self.load().catalog_place(self.bench_name)
        if not create and self.load().catalog.path is None and place.url is None and not place.path.exists():
            raise self._no_catalog(place.path)
        return Catalog.open(place, clock=clock or SystemClock(), create=create, read_only=read_only)

    def open_for_search(self) -> "Catalog":
        """Open the bench's catalog for reading; if its server does not answer, the local copy.

        The journal is delivered before, if there is something in it.
        """
        self.deliver_waiting()
        return self.open_shared()

    def open_shared(self) -> "Catalog":
        """Open the bench's catalog for reading; if its server does not answer, the local copy."""
        from rig.catalog.local_copy import open_or_copy
        from rig.core.clock import SystemClock

        place = self.load().catalog_place(self.bench_name)
        return self.open_catalog(read_only=True) if place.url is None else open_or_copy(place, SystemClock())

    def open_for_enrollment(self, clock: "Clock") -> "Catalog":
        """Open the catalog for new views: the journal of this computer if the catalog is on a server."""
        from rig.catalog.shared import open_for_enrollment

        return open_for_enrollment(self.load().catalog_place(self.bench_name), clock)

    def catalog_to_plan(self, clock: "Clock") -> "Catalog | None":
        """Open the catalog that an enrollment would use; None if there is none yet."""
        place = self.load().catalog_place(self.bench_name)
        return self.existing_catalog() if place.url is None else self.open_for_enrollment(clock)

    def deliver_waiting(self) -> None:
        """Deliver the journal if something is in it."""
        from rig.catalog.journal import waiting
        from rig.core.clock import SystemClock

        if waiting(self.load().catalog_place(self.bench_name), SystemClock()):
            self.deliver()

    def deliver(self, *, replacing: "Collection[str]" = (), now: bool = False) -> "list[Delivery]":
        """Deliver the journal to the server of the catalog; print the delivered objects, and reasons for the others.

        If the server cannot be used, print a note: the journal keeps everything. With ``now`` raise the error.
        """
        from rig.catalog.shared import deliver_journal, delivery_words, failure_words
        from rig.core.clock import SystemClock
        from rig.core.errors import CatalogBusy, CatalogError

        place = self.load().catalog_place(self.bench_name)
        if place.url is None:
            return []
        try:
            done = deliver_journal(place, SystemClock(), replacing=replacing)
        except (CatalogError, CatalogBusy) as error:
            if now:
                raise
            print(f"Note: {failure_words(error)}", file=sys.stderr)
            return []
        for one in done:
            print(f"{'' if one.conflict is None else 'Note: '}{delivery_words(one, place)}", file=sys.stderr)
        return done

    def background_delivery(self) -> "BackgroundDelivery":
        """Return a delivery of the journal during the work of a ``with`` block; its results are printed on stderr."""
        from rig.catalog.shared import BackgroundDelivery
        from rig.core.clock import SystemClock

        return BackgroundDelivery(self.load().catalog_place(self.bench_name), SystemClock(), _report)

    def background_check(self) -> "AbstractContextManager[object]":
        """Return a check of the bench's catalog during the work of a ``with`` block; damage is printed on stderr."""
        from rig.catalog.background import BackgroundCheck
        from rig.core.clock import SystemClock

        place = self.load().catalog_place(self.bench_name)
        if not place.may_exist():
            return nullcontext()

        def report(damage: RigError) -> None:
            _report(f"{damage.what} Next step: {damage.next_step}")

        return BackgroundCheck(place, SystemClock(), report)

    def _no_catalog(self, path: Path) -> RigError:
        """Return the error that the bench has no catalog; it names the benches that have one."""
        from rig.bench import bench_names
        from rig.core.errors import CatalogError

        others = [name for name in bench_names() if self.load().catalog_place(name).database_file.exists()]
        enroll = Do.ENROLL(bench=self.bench_name)
        return CatalogError(
            f"The bench {self.bench_name} has no catalog yet.",
            next_step=(f"Add --bench {others[0]} to use the catalog of that bench, or", enroll) if others else enroll,
            evidence={"folder": str(path), "benches with a catalog": others},
        )

    def existing_catalog(self) -> "Catalog | None":
        """Return the bench's catalog, opened for reading; None if there is none yet."""
        place = self.load().catalog_place(self.bench_name)
        return self.open_catalog(read_only=True) if place.may_exist() else None

    def say(self, text: str, data: Any) -> None:
        """Print ``text``, or with ``--json`` ``data`` as one line of JSON."""
        if self.json:
            self.print_json(data)
        else:
            print(text, flush=True)

    def print_json(self, value: Any) -> None:
        """Print one line of JSON on stdout, at once."""
        print(json.dumps(value, ensure_ascii=False, allow_nan=False, default=str), flush=True)


def _report(text: str) -> None:
    with suppress(OSError):  # stderr is closed
        print(f"Note: {text}", file=sys.stderr, flush=True)
