"""The simulated bench: one world, and the real drivers on simulated wires."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, Field, field_validator

from rig.bench import Bench, BenchKind
from rig.bench.computer import Computer
from rig.bench.hardware import assemble
from rig.config import RigConfig, Section
from rig.core.clock import SystemClock
from rig.core.errors import ObjectNotFound, UsageError
from rig.safety.saved_state import BenchLock, FileStore, MemoryStore, StateStore
from sim.calibration_board import utensils
from sim.change import Change
from sim.clock import VirtualClock
from sim.computer import simulated_computer
from sim.faults import Fault, Faults
from sim.faults.injector import Occurrence
from sim.faults.schedule import read_faults
from sim.noise import NoiseModel
from sim.objects.photographs import Photographed, photographs
from sim.objects.shelf import shelf
from sim.optics import Optics
from sim.parts import SimParts
from sim.world import Thing, World


class SimOptions(Section):
    """The section ``[bench.sim]``."""

    objects: Path | None = Field(None, description="folder of photographs obj{N}__{A}.png; none: the built-in objects")
    object: str | list[str] | None = Field(
        None,
        description="what stands on the table to be identified; of several, one after the other and round again; "
        "none: drawn by the seed",
    )
    yaw_deg: float | None = Field(None, ge=-360, le=360, description="how it stands; none: drawn by the seed")
    noise: dict[str, float] = Field(default_factory=dict, description="values of the noise model that differ")
    head: Literal["memory", "avr"] = Field(
        "memory",
        description="the rig head of imu.connection = head: the firmware built for this computer, or the AVR binary in "
        "an emulated ATmega328P",
    )

    faults: list[Any] = Field(
        default_factory=list, description='what goes wrong, e.g. ["jam@move3+2s"]; rig faults lists what can'
    )

    @field_validator("faults")
    @classmethod
    def _readable(cls, entries: list[Any]) -> list[Any]:
        try:
            read_faults(entries)
        except UsageError as error:
            raise ValueError(f"{error.what} {error.next_step}") from error
        return entries

    @field_validator("noise")
    @classmethod
    def _known(cls, values: dict[str, float]) -> dict[str, float]:
        known = [f.name for f in fields(NoiseModel)]
        unknown = sorted(set(values) - set(known))
        if unknown:
            raise ValueError(f"unknown: {', '.join(unknown)}; there are {', '.join(known)}")
        NoiseModel(**values)  # its own check of the ranges
        return values


class ShelfOperator:
    """The hand that takes things from the shelf: to be enrolled they stand by the platter's mark, to be found anyhow.

    Every placement misses the table's axis by a little, as hands do. Once a bench is open, ``parts`` is what it is made
    of, and ``faults`` what goes wrong with that. ``state`` is what benches in this world remember of the table; whoever
    sets a new one up looks at its cable, and says that it hangs free. The things in ``queue`` are put up to be
    identified one after the other, and round again. Calibration boards and a grey card are at hand, too; the boards
    are seen through the ``optics`` of a camera that the world's seed draws.
    """

    def __init__(
        self, world: World, things: Mapping[str, Thing], *, next_object: str | None = None, yaw_deg: float | None = None
    ) -> None:
        self.world = world
        self.things = things
        self.next_object = next_object
        self.yaw_deg = yaw_deg
        self.queue: deque[str] = deque()
        self.change: Change | None = None
        self.parts: SimParts | None = None
        self.faults: Faults | None = None
        self.state: StateStore = MemoryStore()
        self.optics = Optics.of(world)
        self._rng = world.rng("operator")
        self._days = world.rng("days")

    def place(self, name: str | None) -> None:
        """Put the thing called ``name`` on the table, or the next one to be identified.

        Raises
        ------
        ObjectNotFound
            There is no such thing on the shelf.
        """
        dx_mm, dy_mm = self._rng.normal(0.0, self.world.noise.placement_mm, 2).tolist()
        yaw_deg = 0.0
        if name is None:
            drawn, drawn_deg = str(self._rng.choice(sorted(self.things))), float(self._rng.uniform(0.0, 360.0))
            if self.queue:
                self.next_object = self.queue[0]
                self.queue.rotate(-1)
            name = self.next_object or drawn
            yaw_deg = drawn_deg if self.yaw_deg is None else self.yaw_deg
        if name in (at_hand := utensils(self.optics)):
            self.world.put(at_hand[name])
            return
        if name not in self.things:
            raise ObjectNotFound(
                f"There is no {name!r} on the simulated shelf.",
                next_step="Choose one of those listed, or give a folder of photographs: --set bench.sim.objects=FOLDER",
                evidence={"objects": list(self.things)},
            )
        if self.change is not None:
            self.world.change(light=self.change.light(self._days))
            further_mm = self.change.offset_mm(self._days)
            dx_mm, dy_mm = dx_mm + further_mm[0], dy_mm + further_mm[1]
        self.world.put(self.things[name], yaw_deg, (dx_mm, dy_mm))

    def another_day(self, change: Change) -> None:
        """Have the bench changed from now on; it must be open."""
        assert self.parts is not None
        self.change = change
        self.world.change(light=change.light(self._days))
        change.come_about(self.parts)

    def clear(self) -> bool:
        """Take what is there off the table; a photograph holds its own table, which nobody can clear."""
        if any(isinstance(thing, Photographed) for thing in self.things.values()):
            return False
        self.world.put(None)
        return True


def open_sim_bench(
    config: RigConfig,
    operator: ShelfOperator,
    *,
    faults: Iterable[Fault] = (),
    heard: Callable[[Occurrence], None] | None = None,
    parts: SimParts | None = None,
) -> Bench:
    """Put the real drivers on the simulated wires of the operator's world, by the lines that open a real bench.

    Parameters
    ----------
    config
        The configuration. Where it is given no ``parts``, the simulated servo comes as from the factory and is set up
        over its wire.
    operator
        The hands; they get hold of the ``parts``.
    faults
        What will go wrong, and when.
    heard
        Called when one of them begins or ends.
    parts
        The devices that an earlier bench in this world was opened with; whoever made them takes them away.

    Raises
    ------
    ConfigError
        There is no simulated servo of that model, or it does not know the baud rate.
    DeviceNotFound, DeviceMismatch, DeviceSilent
        A device was made to fail from the start.
    """
    world = operator.world
    config = config.model_copy(update={"servo": config.servo.model_copy(update={"write_settings": True})})
    with ExitStack() as wires:
        owned = parts is None
        if parts is None:
            parts = wires.enter_context(SimParts.connected(config, world))
        operator.parts, operator.faults = parts, Faults(parts)
        if heard:
            operator.faults.listeners.append(heard)
        if owned:
            wires.callback(operator.faults.clear)
        parts.open_wires()
        operator.faults.schedule(*faults)
        bench = assemble(
            "sim",
            config,
            world.clock,
            wire=parts.adapter,
            reopen_serial=parts.reopen_adapter,
            i2c_bus=parts.i2c.path,
            capture=parts.camera,
            reopen_camera=parts.reopen_camera,
            state=operator.state,
            head_port=parts.head_port,
        )
        if operator.state.load().table is None and bench.safety.fault is None:
            if bench.servo.turn_deg < 360.0:  # behind a gear somebody has to look at the table
                bench.safety.set_angle(world.table_deg())
            else:
                bench.safety.set_revolutions(0)
        bench.connections = wires.pop_all()
    bench.operator = operator
    bench.conditions = {"noise": asdict(world.noise), "seed": world.seed}
    return bench


class SimBenchKind:
    """Opens a simulated bench with a world of its own, which begins now: what it stores carries today's date."""

    options: type[BaseModel] = SimOptions

    def open(self, config: RigConfig, options: Any, seed: int | None) -> Bench:
        assert isinstance(options, SimOptions)
        things = photographs(options.objects) if options.objects else shelf()
        with ExitStack() as held:
            state = _state(config, held)
            world = _world(options, seed, _stands_at_deg(config, state))
            single = options.object if isinstance(options.object, str) else None
            operator = ShelfOperator(world, things, next_object=single, yaw_deg=options.yaw_deg)
            operator.queue.extend(options.object if isinstance(options.object, list) else ())
            operator.state = state
            bench = open_sim_bench(config, operator, faults=read_faults(options.faults))
            bench.connections.enter_context(held.pop_all())
        return bench

    @contextmanager
    def computer(self, config: RigConfig, options: Any, seed: int | None) -> Iterator[Computer]:
        """Yield the simulated computer; the devices' faults that need no motion happen there, too."""
        assert isinstance(options, SimOptions)
        with SimParts.connected(config, _world(options, seed)) as parts, simulated_computer(config, parts) as computer:
            faults = Faults(parts)
            faults.schedule(*read_faults(options.faults))
            try:
                yield computer
            finally:
                faults.clear()


def _world(options: SimOptions, seed: int | None, start_deg: float = 0.0) -> World:
    clock = VirtualClock(start_utc=SystemClock().utc())
    return World(noise=NoiseModel(**options.noise), seed=seed or 0, clock=clock, start_deg=start_deg)


def _state(config: RigConfig, held: ExitStack) -> StateStore:
    """Return where the bench's state is kept: in memory, unless the configuration says where it should outlive us."""
    if config.state_dir is None:
        return MemoryStore()
    path = config.state_path("sim")
    held.callback(BenchLock(path, SystemClock()).close)
    return FileStore(path)


def _stands_at_deg(config: RigConfig, state: StateStore) -> float:
    """Return where the last simulated run left the table: as on a real bench, only the supply was off meanwhile."""
    table = state.load().table
    if table is None:
        return 0.0
    turn_deg = 360.0 / config.servo.gear_ratio
    turns = round(table.shift_deg / turn_deg)  # the rest of the shift is a zero that a person declared
    return table.position_deg + (turns - 0.5) * turn_deg


SIM: BenchKind = SimBenchKind()
