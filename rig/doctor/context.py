"""The subject of the checks: a computer, and the bench of a configuration."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rig.bench import bench_kind
from rig.bench.computer import Computer
from rig.config import RigConfig
from rig.config.values import validate
from rig.core.next_steps import Do, NextStep
from rig.safety.saved_state import Holder, busy, holder


@dataclass
class DoctorContext:
    """A bench that is not open, and the computer to which its devices are connected."""

    computer: Computer
    config: RigConfig
    bench: str
    options: tuple[str, ...] = ()
    """Options of `rig` that select this bench: ``--bench sim``."""
    file_options: tuple[str, ...] = ()
    """Options of `rig config set` that select this configuration file."""
    holder: Holder | None = None
    """The program that uses the bench now."""
    identities: dict[str, dict[str, Any]] = field(default_factory=dict)
    """The devices that the checks found, for later checks."""

    def step(self, step: NextStep) -> NextStep:
        """Return a step whose command is for this bench."""
        return step.with_options(self.file_options if step.action is Do.SET_KEY else self.options)

    @property
    def catalog_path(self) -> Path:
        return self.config.catalog_path(self.bench)

    def require_free(self) -> None:
        """Raise `BenchBusy` while another program works with the bench."""
        if self.holder is not None:
            raise busy(self.config.state_path(self.bench), self.holder)


@contextmanager
def open_context(
    bench: str,
    config: RigConfig,
    *,
    seed: int | None = None,
    options: tuple[str, ...] = (),
    file_options: tuple[str, ...] = (),
    is_held: bool = False,
) -> Iterator[DoctorContext]:
    """Yield a bench to check; its computer is this one unless the bench provides another.

    ``is_held`` says that this program holds the bench, and has closed its devices.

    Raises `ConfigError`: there is no such bench, or its options have mistakes.
    """
    kind = bench_kind(bench)
    chosen = validate(kind.options, config.bench.get(bench, {}), where="the configuration", prefix=f"bench.{bench}")
    config = kind.fitted(config, chosen)
    try:
        who = None if is_held else holder(config.state_path(bench))
    except OSError:  # the folder is not readable: the check of the bench's state reports it
        who = None
    with kind.computer(config, chosen, seed) as computer:
        yield DoctorContext(computer, config, bench, options, file_options, who)
