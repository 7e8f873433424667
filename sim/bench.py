"""The simulated bench: one simulated world, and the real drivers connected to simulated devices."""

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel, Field, ValidationError, field_validator

from rig.bench import Bench, BenchKind
from rig.bench.bench import DEVICES
from rig.bench.computer import Computer
from rig.bench.hardware import assemble
from rig.config import RigConfig, Section
from rig.core.clock import SystemClock
from rig.core.errors import ObjectNotFound, UsageError
from rig.core.json_form import plain
from rig.safety.saved_state import BenchLock, FileStore, MemoryStore, StateStore
from sim.calibration_board import HOME_MARK, boards, home_mark
from sim.change import Change
from sim.clock import PacedClock, VirtualClock
from sim.computer import SimComputer, simulated_computer
from sim.devices import SimDevices
from sim.faults import Fault, Faults
from sim.faults.injector import Occurrence
from sim.noise import NoiseModel
from sim.objects.projection import Image
from sim.objects.shelf import shelf
from sim.objects.solid import empty_platter
from sim.optics import Optics
from sim.world import SimObject, World

_NO_FILES: Final = Path("/nonexistent")
_UNPLUGGED_S: Final = 8.0  # long enough to see what the pages say
_SHOWN_DEG: Final = 25.0  # most objects show their handle and their picture from there


class SimOptions(Section):
    """The section ``[bench.sim]``."""

    object: str | list[str] | None = Field(
        None, description="object on the table to identify, or a list that is repeated; default: random, from the seed"
    )
    yaw_deg: float | None = Field(None, ge=-360, le=360, description="its rotation; default: random, from the seed")
    mark: bool = Field(False, description="whether the card of the home mark stands on the platter")
    speed: float | None = Field(
        None, gt=0, le=1000, description="simulated seconds per second; default: as fast as the computer can"
    )
    noise: dict[str, Any] = Field(default_factory=dict, description="noise model: values to change")
    faults: list[str] = Field(
        default_factory=list, description='simulated faults, e.g. ["jam@move3+2s"]; rig faults lists them'
    )

    @field_validator("faults")
    @classmethod
    def _readable(cls, entries: list[str]) -> list[str]:
        try:
            for entry in entries:
                Fault.parse(entry)
        except UsageError as error:
            raise ValueError(f"{error.what} {error.next_step}") from error
        return entries

    @field_validator("noise")
    @classmethod
    def _possible(cls, values: dict[str, Any]) -> dict[str, Any]:
        known = [f.name for f in fields(NoiseModel)]
        if unknown := sorted(set(values) - set(known)):
            raise ValueError(f"unknown: {', '.join(unknown)}; there are {', '.join(known)}")
        try:
            NoiseModel(**values)
        except ValidationError as error:
            mistake = error.errors()[0]
            name = "".join(f"{part}: " for part in mistake["loc"][:1])
            raise ValueError(name + mistake["msg"].removeprefix("Value error, ")) from None
        return values


class ShelfOperator:
    """The simulated operator: puts objects on the table, on the mark to enroll, in any orientation to identify.

    Each object stands a little off the table's axis. Calibration boards are available, too.
    """

    backdrop: Image | None = None
    """See `sim.camera.SimCapture`."""
    findings: tuple[str, ...] = ()
    """Notes for the operator."""

    def __init__(
        self,
        world: World,
        objects: Mapping[str, SimObject],
        *,
        next_object: str | None = None,
        yaw_deg: float | None = None,
    ) -> None:
        self.world = world
        self.objects = objects
        self.next_object = next_object
        self.yaw_deg = yaw_deg
        self.queue: deque[str] = deque()
        """Objects to identify, one after the other; the queue repeats."""
        self.change: Change | None = None
        self.devices: SimDevices | None = None
        self.faults: Faults | None = None
        """The simulated devices and faults of the bench, once it is open."""
        self.state: StateStore = MemoryStore()
        """Store for the state of the table on the benches of this world."""
        self.optics = Optics.of(world)
        """The camera's optics for the boards, drawn from the world's seed."""
        self.targets: Mapping[str, SimObject] = boards(self.optics)
        """Calibration boards, by name."""
        self._rng = world.rng("operator")
        self._days = world.rng("days")

    def place(self, name: str | None) -> None:
        """Put the object called ``name`` on the table, or the next one to identify.

        Raises `ObjectNotFound` if no object has that name.
        """
        dx_mm, dy_mm = self._rng.normal(0.0, self.world.noise.placement_mm, 2).tolist()
        yaw_deg = 0.0
        if to_identify := name is None:
            drawn, drawn_deg = str(self._rng.choice(sorted(self.objects))), float(self._rng.uniform(0.0, 360.0))
            if self.queue:
                self.next_object = self.queue[0]
                self.queue.rotate(-1)
            name = self.next_object or drawn
            yaw_deg = drawn_deg if self.yaw_deg is None else self.yaw_deg
        if name == HOME_MARK:
            self.world.change(mark=home_mark(self.optics))
            return
        if name in self.targets:
            self.world.put(self.targets[name])
            return
        placed = self.thing(name, to_identify=to_identify)
        if self.change is not None:
            assert self.devices is not None
            self.change.visit(self.devices, self._days)
            self.world.change(light=self.change.light(self._days))
            further_mm = self.change.offset_mm(self._days)
            dx_mm, dy_mm = dx_mm + further_mm[0], dy_mm + further_mm[1]
        self.world.put(placed, yaw_deg, (dx_mm, dy_mm))

    def thing(self, name: str, *, to_identify: bool) -> SimObject:  # noqa: ARG002
        """Return the object called ``name``, to enroll or to identify it.

        Raises `ObjectNotFound` if no object has that name.
        """
        if name not in self.objects:
            raise ObjectNotFound(
                f"The simulated bench has no object {name!r}.",
                next_step="Choose a listed object.",
                evidence={"objects": list(self.objects)},
            )
        return self.objects[name]

    def change_bench(self, change: Change) -> None:
        """Change the bench from now on; it must be open."""
        assert self.devices is not None
        self.change = change
        self.world.change(light=change.light(self._days))
        change.apply_to(self.devices)
        change.visit(self.devices, self._days)

    def clear(self) -> bool:
        """Clear the table and return whether that is possible."""
        self.world.put(None)
        return True


class SimShelf:
    """The shelf of a simulated bench: a person at a page puts its objects on the table, and changes the bench."""

    def __init__(self, operator: ShelfOperator, unplug: Callable[[], None]) -> None:
        self._operator = operator
        self._unplug = unplug

    @property
    def things(self) -> list[str]:
        return list(self._operator.objects)

    def picture(self, name: str) -> Image:
        """Return a picture of an object on the platter, uint8 (480, 480, 3)."""
        thing, image = self._operator.thing(name, to_identify=False), empty_platter()
        thing.draw(image, _SHOWN_DEG, (0.0, 0.0))
        return image[:, 80:560]

    def state(self) -> dict[str, Any]:
        scene, faults = self._operator.world.scene, self._operator.faults
        return {
            "object": scene.object.name if scene.object else None,
            "light": scene.light[0],
            "faults": [fault.kind.name for fault in faults.active] if faults else [],
        }

    def do(self, words: Sequence[str]) -> None:
        """Put an object on the table in any orientation, clear the table, set the light, or unplug the camera a while.

        Raises `UsageError`, `ObjectNotFound`: there is no such thing to do, or no such object.
        """
        operator = self._operator
        match words:
            case ["put", name]:
                operator.next_object = operator.thing(name, to_identify=True).name
                operator.place(None)
            case ["clear"]:
                operator.world.put(None)
            case ["light", ("0.25" | "0.5" | "1" | "1.5") as factor]:
                operator.world.change(light=(float(factor),) * 3)
            case ["unplug"]:
                self._unplug()
            case _:
                raise UsageError("Hands cannot do that.", next_step="put NAME, clear, light 0.5, or unplug.")


def open_sim_bench(
    config: RigConfig,
    operator: ShelfOperator,
    *,
    faults: Iterable[Fault] = (),
    on_fault: Callable[[Occurrence], None] | None = None,
    devices: SimDevices | None = None,
    open_now: Collection[str] = DEVICES,
    name: str = "sim",
) -> Bench:
    """Open a bench whose real drivers are connected to simulated devices, by the code that opens a real bench.

    The devices are in the world of ``operator``, and the ``faults`` happen at their times; ``on_fault`` is called when
    one begins or ends. ``devices`` are those of an earlier bench in this world, which the caller closes. Without them,
    the simulated servo has factory settings and is configured over its bus. ``open_now`` as for `rig.bench.open_bench`.

    Raises `ConfigError`: the simulator has no servo of that model, or the model does not support the baud rate.
    `DeviceNotFound`, `DeviceMismatch`, `DeviceSilent`: a simulated fault affects a device from the start.
    """
    world = operator.world
    config = config.model_copy(update={"servo": config.servo.model_copy(update={"write_settings": True})})
    with ExitStack() as wires:
        owned = devices is None
        if devices is None:
            devices = wires.enter_context(SimDevices.connected(config, world, operator.backdrop))
        if operator.backdrop is not None:  # objects of another size do not fit into the frame
            devices.objects = operator.objects
        operator.devices, operator.faults = devices, Faults(devices)
        if on_fault:
            operator.faults.listeners.append(on_fault)
        if owned:
            wires.callback(operator.faults.clear)
        operator.faults.schedule(*faults)
        # Assemble the bench, with a cable that is not wound up in a new world.
        computer = SimComputer(_NO_FILES, devices, config)  # opening a bench looks for no other devices
        bench = assemble(name, config, world.clock, computer, state=operator.state)
        if operator.state.load().table is None and bench.safety.fault is None:
            if bench.servo.revolution_deg < 360.0:  # with a gear, the servo alone does not know the table's angle
                bench.safety.set_angle(world.table_deg())
            else:
                bench.safety.set_revolutions(0)
        try:
            bench.open_devices(open_now)
        except BaseException:
            bench.close()
            raise
        bench.connections = wires.pop_all()
    bench.placer = operator
    bench.conditions = plain({"noise": world.noise, "seed": world.seed})  # as a calibration stores them
    return bench


class SimBenchKind(BenchKind):
    """The kind of bench ``sim``: a simulated bench in a new world whose clock starts at the computer's time."""

    name = "sim"
    options: type[BaseModel] = SimOptions
    _camera_back_ns = 0
    """When the camera is plugged in again, on the computer's clock: a bench that is opened before has none either."""

    def prepare(self, config: RigConfig, options: Any, world: World) -> tuple[RigConfig, ShelfOperator]:  # noqa: ARG002
        """Return the bench's configuration, and the operator with what is on the bench."""
        return config, ShelfOperator(world, shelf())

    def open(self, config: RigConfig, options: Any, seed: int | None) -> Bench:
        assert isinstance(options, SimOptions)
        with ExitStack() as held:
            state = _state(self.name, config, held)
            config, operator = self.prepare(config, options, new_world(options, seed, rest_angle_deg(config, state)))
            operator.next_object = options.object if isinstance(options.object, str) else None
            operator.yaw_deg = options.yaw_deg
            if options.mark:
                operator.place(HOME_MARK)
            operator.queue.extend(options.object if isinstance(options.object, list) else ())
            operator.state = state
            faults = [*map(Fault.parse, options.faults), *self._unplugged(options)]
            bench = open_sim_bench(config, operator, faults=faults, open_now=(), name=self.name)
            bench.findings += operator.findings
            if options.object is None:
                bench.shelf = SimShelf(operator, partial(self._unplug, operator, options))
            bench.connections.enter_context(held.pop_all())
        return bench

    def _unplug(self, operator: ShelfOperator, options: SimOptions) -> None:
        self._camera_back_ns = SystemClock().now_ns() + round(_UNPLUGGED_S * 1e9)
        assert operator.faults is not None
        operator.faults.schedule(*self._unplugged(options))

    def _unplugged(self, options: SimOptions) -> list[Fault]:
        """Return the fault of the unplugged camera until it is plugged in again; none if it is plugged in."""
        left_s = (self._camera_back_ns - SystemClock().now_ns()) * 1e-9 * (options.speed or 1.0)
        return [Fault.parse(f"camera.off@0s+{left_s:.6f}s")] if left_s > 0 else []

    @contextmanager
    def computer(self, config: RigConfig, options: Any, seed: int | None) -> Iterator[Computer]:
        """Yield the simulated computer with the faults that need no motion."""
        assert isinstance(options, SimOptions)
        config, operator = self.prepare(config, options, new_world(options, seed))
        with (
            SimDevices.connected(config, operator.world, operator.backdrop) as devices,
            simulated_computer(config, devices) as computer,
        ):
            faults = Faults(devices)
            faults.schedule(*map(Fault.parse, options.faults))
            try:
                yield computer
            finally:
                faults.clear()


def new_world(options: SimOptions, seed: int | None, start_deg: float = 0.0) -> World:
    """Return a world whose clock starts at the computer's time."""
    computer = SystemClock()
    clock = VirtualClock(computer.utc()) if options.speed is None else PacedClock(options.speed, computer)
    return World(noise=NoiseModel(**options.noise), seed=seed or 0, clock=clock, start_deg=start_deg)


def _state(name: str, config: RigConfig, held: ExitStack) -> StateStore:
    """Return the store of the bench's state: in memory, unless the configuration names a folder."""
    if config.state_dir is None:
        return MemoryStore()
    path = config.state_path(name)
    held.callback(BenchLock(path, SystemClock()).close)
    return FileStore(path)


def rest_angle_deg(config: RigConfig, state: StateStore) -> float:
    """Return the angle at which the last simulated run left the table, as if only the supply had been off since."""
    table = state.load().table
    if table is None:
        return 0.0
    revolution_deg = 360.0 / config.servo.gear_ratio
    revolutions = round(table.shift_deg / revolution_deg)  # the rest of the shift is a home that the operator set
    return table.position_deg + (revolutions - 0.5) * revolution_deg


SIM: BenchKind = SimBenchKind()
