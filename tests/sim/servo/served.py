"""Servos on a pseudo-terminal in a process of their own, in real time, for programs that know no simulation."""

from pathlib import Path

from rig.config import ServoConfig
from sim.devices import simulated_servo
from sim.realtime.pace import RealTime
from sim.realtime.port import PtyPort
from sim.servo import ServoBus, SimSerial
from sim.world import World
from tests.programs import Program


def start(link: Path, *ids: int) -> Program:
    """Start servos on one bus, each in a world of its own; return when ``link`` is their port."""
    program = Program(code=f"from tests.sim.servo.served import serve; serve({str(link)!r}, {ids or (1,)})")
    assert program.stdout is not None
    assert program.stdout.readline() == "serving\n"
    return program


def serve(link: str, ids: tuple[int, ...]) -> None:
    """Let the time of the servos pass until the process is killed."""
    worlds = [World(seed=ids[0])]
    worlds += [World(seed=number, clock=worlds[0].clock) for number in ids[1:]]
    bus = ServoBus(worlds[0].clock)
    for world, number in zip(worlds, ids, strict=True):
        bus.attach(simulated_servo(world, ServoConfig(id=number)))
    adapter = SimSerial(bus, ServoConfig().baud, 0.0)
    port = PtyPort(lambda: adapter, Path(link))
    print("serving", flush=True)
    RealTime(bus.clock, [port]).run()
