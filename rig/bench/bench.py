"""A bench, and opening one by name.

Kinds of benches are plug-ins of the entry-point group `rig.benches`: `hardware`, `sim`, and those of other packages.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from difflib import get_close_matches
from functools import cache, partial
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from rig.bench.computer import Computer
from rig.calibrations import CalibrationStatus, CalibrationStore, apparatus, apply_results
from rig.calibrations.store import CALIBRATIONS
from rig.config import RigConfig
from rig.config.toml_file import changed_lines, read_text, save, with_values
from rig.config.values import Values, config_mistakes, parsed, read_values, validate
from rig.core.clock import Clock
from rig.core.errors import ConfigError, RigError, TorqueStaysOn
from rig.core.masking import masked
from rig.core.next_steps import Do, NextSteps
from rig.core.notify import notify
from rig.core.signals import uninterrupted
from rig.devices.camera import Camera
from rig.devices.head.head import RigHead
from rig.devices.imu import Imu
from rig.devices.servo import Servo
from rig.devices.trace import TraceWriter
from rig.safety.saved_state import MemoryStore, SessionEnd, StateStore
from rig.safety.supervisor import Safety

GROUP = "rig.benches"
DEVICES = ("imu", "camera")
"""The devices that can be opened later than the servo."""


class Placer(Protocol):
    """Puts objects on the table, so that no person has to: a robot, or the simulated operator."""

    def place(self, name: str | None) -> None:
        """Wait until the object ``name`` (None: the one to identify) is on the table, and the hands are away."""

    def clear(self) -> bool:
        """Return True when the table is empty; False if that is not possible."""


class Shelf(Protocol):
    """What hands do at a simulated bench. A page lets a person do it, who then is the one who places the objects."""

    @property
    def things(self) -> Sequence[str]:
        """The objects that can be put on the table."""

    def picture(self, name: str) -> NDArray[np.uint8]:
        """Return a picture of an object, BGR. Raises `ObjectNotFound`."""

    def state(self) -> dict[str, Any]:
        """Return what is on the table, the light and the faults, as plain data."""

    def do(self, words: Sequence[str]) -> None:
        """Do something by hand. Raises `UsageError`: it is not possible."""


@dataclass(slots=True)
class Bench(AbstractContextManager["Bench"]):
    """The devices of one bench, on one clock. IMU and camera are opened at their first use, or by `open_devices`."""

    name: str
    config: RigConfig
    clock: Clock
    servo: Servo
    open_imu: Callable[[], Imu] = field(repr=False)
    open_camera: Callable[[], Camera] = field(repr=False)
    """Open the device; `imu` and `camera` call them once."""
    placer: Placer | None = None
    """Puts objects on the table; None if a person does that, before a plan begins."""
    shelf: Shelf | None = None
    """The hands of a simulated bench; None if the bench is a real one, or its objects are placed by a script."""
    conditions: Mapping[str, Any] = field(default_factory=dict)
    """The noise model or the calibrations in force; stored with every enrollment."""
    findings: tuple[str, ...] = ()
    """Notes for the operator from the opening of the bench; stored with every enrollment."""
    calibration_findings: tuple[str, ...] = field(default=(), init=False)
    """The findings about calibrations that are not in force, or only in part."""
    calibration_steps: NextSteps = field(default=(), init=False)
    """The next step: the calibrations to be repeated."""
    state: StateStore = field(default_factory=MemoryStore, repr=False)
    """Stores the table's revolutions and faults for the next program."""
    head: RigHead | None = None
    """The rig head that `imu` is connected to; None if `imu` is on the computer's own I2C bus."""
    trace: TraceWriter | None = field(default=None, repr=False)
    """Records what `servo`, `imu`, `head` and `camera` exchange with their devices; None without ``config.trace``."""
    connections: ExitStack = field(default_factory=ExitStack, repr=False)
    """Connections that must be closed after the devices."""
    safety: Safety = field(init=False, repr=False)
    _imu: Imu | None = field(default=None, init=False, repr=False)
    _camera: Camera | None = field(default=None, init=False, repr=False)
    _end: SessionEnd = field(default=SessionEnd.FINISHED, init=False, repr=False)
    _open: bool = field(default=True, init=False, repr=False)
    _as_opened: tuple[RigConfig, tuple[str, ...]] | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        self.safety = Safety(self.servo, self.config, self.clock, self.state)
        self.safety.fault_observers.append(self._notify_fault)

    def _notify_fault(self, error: RigError) -> None:
        message = {"event": "fault", "bench": self.name, "text": f"{self.name}: {error.what}", "fault": error.problem}
        notify(self.config.notify_command, message)

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        self._end = SessionEnd.of(error)
        try:
            self.close()
        except (RigError, OSError) as failure:
            # Of two errors the first one is important, unless the torque stays on. An interruption is no error.
            if error is None or isinstance(failure, TorqueStaysOn) or not isinstance(error, Exception):
                raise
            error.add_note(f"Closing the bench failed: {failure}")

    def close(self) -> None:
        """Switch the torque off and close all devices, even if one of them fails; a second call does nothing."""
        if not self._open:
            return
        # The torque first, whatever fails later. The trace last: it records how the others are closed.
        steps: list[Callable[[], object]] = [
            self.servo.torque_off,
            partial(self.safety.end_session, self._end),
            self.servo.close,
            *(device.close for device in (self._imu, self._camera) if device is not None),
            self.connections.close,
            *((self.trace.close,) if self.trace else ()),
        ]
        failures: list[Exception] = []
        with uninterrupted():  # a second Ctrl+C must not leave the torque on
            self._open = False
            for step in steps:
                try:
                    step()
                except (RigError, OSError) as failure:
                    if isinstance(failure, TorqueStaysOn):
                        self.safety.latch(failure)
                    # A servo whose supply the rig head's relay cuts does not answer, and has no torque either.
                    powered = self.head is None or not self.config.head.power or self.head.status.relay_closed
                    if powered or step != self.servo.torque_off:
                        failures.append(failure)
        if failures:
            raise failures[0]

    def place(self, name: str | None) -> None:
        """Let the placer put an object on the table, as `Placer.place`; without a placer, it is there already."""
        if self.placer is not None:
            self.placer.place(name)

    @property
    def imu(self) -> Imu:
        """The IMU; the first use opens it, and raises as `open_devices`."""
        if self._imu is None:
            self._imu = self.open_imu()
        return self._imu

    @imu.setter
    def imu(self, imu: Imu) -> None:
        self._imu = imu

    @property
    def camera(self) -> Camera:
        """The camera; the first use opens it, and raises as `open_devices`."""
        if self._camera is None:
            self._camera = self.open_camera()
        return self._camera

    def open_devices(self, parts: Collection[str]) -> None:
        """Open ``imu`` and ``camera`` now, not at their first use.

        Raises `DeviceNotFound`, `DeviceMismatch`, `DeviceSilent`: a device is missing, is another one, or does not
        answer.
        """
        for part in parts:
            getattr(self, part)

    def devices(self) -> dict[str, Any]:
        """Return the identities of the devices, for records; it opens those that are not open yet."""
        self.open_devices(DEVICES)
        return self._identities()

    def _identities(self) -> dict[str, Any]:
        devices = {"servo": self.servo, "imu": self._imu, "camera": self._camera}
        return {part: asdict(device.identity) for part, device in devices.items() if device is not None}

    def apparatus(self, *parts: str) -> dict[str, Any]:
        """Return the part of the bench that a calibration of ``parts`` (default: all open devices) depends on."""
        self.open_devices([part for part in parts if part in DEVICES])
        whole = apparatus(self.name, self._identities(), self.config, self.conditions)
        return {key: value for key, value in whole.items() if not parts or key in ("bench", "conditions", *parts)}


class BenchKind(ABC):
    """A plug-in: a kind of bench, and how to open it. ``options`` is the model of the section ``[bench.<name>]``."""

    options: type[BaseModel]

    @abstractmethod
    def open(self, config: RigConfig, options: Any, seed: int | None) -> Bench:
        """Open the devices; if one fails, close those already opened."""

    @contextmanager
    def open_servo(self, config: RigConfig, options: Any, seed: int | None) -> Iterator[Servo]:
        """Open the servo to stop it, without the other devices if the kind can do that: one of them may fail."""
        with self.open(config, options, seed) as bench:
            yield bench.servo

    @contextmanager
    def computer(self, config: RigConfig, options: Any, seed: int | None) -> Iterator[Computer]:  # noqa: ARG002
        """Yield the computer to which the devices are connected, while the bench is not open."""
        yield Computer()

    def fitted(self, config: RigConfig, options: Any) -> RigConfig:  # noqa: ARG002
        """Return the configuration with settings that follow from the options, such as the size of the frames."""
        return config


def bench_names() -> list[str]:
    """Return the names of the installed kinds of benches."""
    return sorted(_plugins())


@cache
def _plugins() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUP)}


def open_bench(
    name: str | None = None,
    config: RigConfig | None = None,
    *,
    seed: int | None = None,
    devices: Collection[str] = DEVICES,
) -> Bench:
    """Open a bench by its name (`bench_names`), by default ``config.default_bench``; use it in a ``with`` block.

    The servo and ``devices`` are opened now, the others when they are first used. A real bench ignores the ``seed``.

    Raises `ConfigError`: the bench does not exist, or its options have mistakes. `DeviceNotFound`, `DeviceMismatch`,
    `DeviceSilent`: a device is missing, is another one, or does not answer. `BenchBusy`: another program uses the
    bench.
    """
    config = config or RigConfig()
    kind, options = _kind(name or config.default_bench, config)
    bench = kind.open(config, options, seed)
    # Calibrations are applied last: which of them are in force depends on the devices that answered.
    try:
        bench.open_devices(devices)
        calibrate(bench, CalibrationStore(config.calibration_path(bench.name)))
    except BaseException:
        bench.close()
        raise
    return bench


@contextmanager
def open_servo(name: str | None = None, config: RigConfig | None = None, *, seed: int | None = None) -> Iterator[Servo]:
    """Open only the servo of a bench (all devices if its kind cannot do that); write nothing to it.

    Raises ConfigError, DeviceNotFound, DeviceMismatch, DeviceSilent, BenchBusy as in `open_bench`.
    """
    config = config or RigConfig()
    kind, options = _kind(name or config.default_bench, config)
    with kind.open_servo(config, options, seed) as servo:
        yield servo


def calibrate(bench: Bench, store: CalibrationStore) -> None:
    """Apply the bench's calibrations; one that has expired or belongs to other devices becomes a finding.

    A second call also applies new calibrations.

    Raises `ConfigError`: a calibration sets a value that the configuration does not allow.
    """
    # Always from the configuration as it was opened: a calibration that was replaced must leave nothing behind.
    bench._as_opened = bench._as_opened or (bench.config, bench.findings)
    config, findings = bench._as_opened
    calibrations = store.on_bench(bench.apparatus(), bench.clock.utc())
    in_force = [one.result for one in calibrations if one.status is CalibrationStatus.IN_FORCE]
    others = [one for one in calibrations if one.status is not CalibrationStatus.IN_FORCE]
    bench.config, notes = apply_results(config, in_force)
    bench.safety.angle_reference.calibrate(bench.config.table)
    bench.conditions = {**bench.conditions, CALIBRATIONS: [result.id for result in in_force]}
    bench.calibration_findings = (
        *notes,
        *(error.what for error in store.unreadable),
        *(str(one).removesuffix(".") for one in others),
    )
    bench.calibration_steps = tuple(one.repetition for one in others)
    bench.findings = (*findings, *bench.calibration_findings)


def _kind(name: str, config: RigConfig) -> tuple[BenchKind, BaseModel]:
    """Return the kind of bench called ``name``, and its options."""
    # Report a misspelt section before anything is opened.
    for wrong in sorted(set(config.bench) - set(bench_names())):
        bench_kind(wrong)
    kind = bench_kind(name)
    where = "the configuration"
    return kind, validate(kind.options, config.bench.get(name, {}), where=where, prefix=f"bench.{name}")


def bench_kind(name: str) -> BenchKind:
    """Return the plug-in of that name.

    Raises `ConfigError`: the bench does not exist.
    """
    if name in _plugins():
        kind: BenchKind = _plugins()[name].load()
        return kind
    near = get_close_matches(name, bench_names(), n=1)
    raise ConfigError(
        f"There is no bench {name!r}.",
        next_step=f"Did you mean {near[0]}?" if near else "Use one of the listed benches.",
        evidence={"benches": bench_names()},
    )


def check_config(read: Values) -> tuple[RigConfig, dict[str, BaseModel]]:
    """Return the configuration and the options of every bench that is installed.

    Raises `ConfigError`: the evidence lists all mistakes, including those in the benches' own sections.
    """
    # Collect all mistakes, so that one correction of the file is enough.
    found: list[str] = []
    config, options = RigConfig(), {}
    where = str(read.path) if read.path else "the command line"
    try:
        config = validate(RigConfig, read.values, where=where)
    except ConfigError as error:
        found += error.evidence["mistakes"]
    sections = read.values.get("bench", {})
    if not isinstance(sections, dict) or not all(isinstance(section, dict) for section in sections.values()):
        sections = {}  # already reported above
    for name in sorted({*bench_names(), *sections}):
        try:
            kind = bench_kind(name)
            options[name] = validate(kind.options, sections.get(name, {}), where=where, prefix=f"bench.{name}")
        except ConfigError as error:
            found += error.evidence.get("mistakes") or [f"bench.{name}: {error.what} {error.next_step}"]
    if found:
        raise config_mistakes(found, where, read.lines)
    return config, options


def set_key(target: Path, key: str, value: str, overrides: Iterable[str] = ()) -> list[str]:
    """Set a key in a file to a value as in TOML, and return the changed lines; comments and other keys stay.

    Raises `ConfigError`: there is no such key, or the configuration would have mistakes.
    """
    there = target.exists()
    old = read_text(target) if there else ""
    try:
        check_config(read_values(target if there else None, [*overrides, f"{key}={value}"]))
    except ConfigError as error:
        raise ConfigError(
            f"{target} is unchanged: it would have mistakes.",
            next_step=("Give another value. To choose one,", Do.SHOW_CONFIGURATION()),
            evidence=error.evidence,
        ) from error
    new = with_values(old, {tuple(key.split(".")): parsed(value)})
    if new != old:
        save(target, new)
    changed: list[str] = masked(changed_lines(old, new))
    return changed
