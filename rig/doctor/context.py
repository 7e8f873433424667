"""What is examined: a computer, and the bench that a configuration describes."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from shlex import quote
from typing import Any

from rig.bench import bench_kind
from rig.bench.computer import Computer, ComputerProvider, LinuxComputer
from rig.config import RigConfig
from rig.config.values import validate
from rig.safety.saved_state import Holder, busy, holder


@dataclass
class DoctorContext:
    """A bench that is not opened, and the computer where its devices are looked for.

    Attributes
    ----------
    options
        What `rig` must be given to mean the same bench: ``--bench sim``.
    file_options
        What `rig config set` must be given to mean the same file.
    holder
        Who works with the bench now.
    identities
        The devices that were met, put here by the checks for those that come after them.
    """

    computer: Computer
    config: RigConfig
    bench: str
    options: tuple[str, ...] = ()
    file_options: tuple[str, ...] = ()
    holder: Holder | None = None
    identities: dict[str, dict[str, Any]] = field(default_factory=dict)

    def rig(self, command: str) -> str:
        """Return a command line for this bench."""
        return " ".join(["rig", command, *map(quote, self.options)])

    def set(self, key: str, value: Any) -> str:
        """Return the command that changes one key of the configuration."""
        return " ".join(["rig config set", key, quote(str(value)), *map(quote, self.file_options)])

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
) -> Iterator[DoctorContext]:
    """Yield a bench to be examined; for one that brings no computer of its own it is this one.

    Raises
    ------
    ConfigError
        There is no such bench, or its options have mistakes.
    """
    kind = bench_kind(bench)
    chosen = validate(kind.options, config.bench.get(bench, {}), where="the configuration", prefix=f"bench.{bench}")
    try:
        who = holder(config.state_path(bench))
    except OSError:  # the folder may not be read: the check of the bench's state tells
        who = None
    if isinstance(kind, ComputerProvider):
        with kind.computer(config, chosen, seed) as computer:
            yield DoctorContext(computer, config, bench, options, file_options, who)
    else:
        yield DoctorContext(LinuxComputer(), config, bench, options, file_options, who)
