"""What goes wrong with the servo, its gears and its line."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from sim.faults.kind import Delay, End, Parameter, kind, repeatedly, share
from sim.parts import SimParts
from sim.servo import Ax12Servo, Frame, XSeriesServo
from sim.servo.configured import SimulatedServo
from sim.servo.control_table import Memory
from sim.servo.device import OVERLOAD_ERROR
from sim.world import World

Values = Mapping[str, float]

LOWEST_SUPPLY_V = 4.5
"""Below it the servo's controller resets; the e-manual gives no number."""
_OTHER_MODEL = 1020
"""Model Number of an XM430-W350."""
_ANOTHER = 1060


def _tamper(parts: SimParts, change: Callable[[Frame], Frame | None]) -> End:
    parts.servo_bus.tampers.append(change)
    return lambda: parts.servo_bus.tampers.remove(change)


def _distort(parts: SimParts, change: Callable[[Memory], None]) -> End:
    parts.servo.distortions.append(change)
    return lambda: parts.servo.distortions.remove(change)


def _later(frame: Frame, seconds: float) -> Frame:
    return replace(frame, start_ns=frame.start_ns + round(seconds * 1e9))


# -- the device -------------------------------------------------------------------------------------------------------


@kind("servo.off", "The servo has no supply; afterwards it boots, and has forgotten its turns.")
def _off(parts: SimParts, _values: Values, _rng: np.random.Generator) -> End:
    parts.servo.power_off()
    return parts.servo.power_on


@kind("servo.stuck", "The servo's status registers stay as they are, whatever the shaft does.")
def _stuck(parts: SimParts, _values: Values, _rng: np.random.Generator) -> End:
    kept: list[bytes] = []

    def hold(memory: Memory) -> None:
        kept.append(memory.live())
        memory.set_live(kept[0])

    return _distort(parts, hold)


@kind("servo.garbage", "The servo's status registers hold random bytes, under a valid CRC.")
def _garbage(parts: SimParts, _values: Values, rng: np.random.Generator) -> End:
    return _distort(parts, lambda memory: memory.set_live(rng.bytes(len(memory.live()))))


@kind(
    "servo.wrong",
    "The encoder's magnet slips on the shaft: the servo goes where it should not.",
    angle=Parameter(5.0, "by how much, °", -90, 90),
)
def _wrong(parts: SimParts, values: Values, _rng: np.random.Generator) -> End:
    parts.servo.slip_encoder(values["angle"])
    return lambda: None


@kind(
    "servo.slow",
    "Each answer comes late, but in time: a USB adapter with its latency timer at 16 ms.",
    seconds=Parameter(0.01, "how late, s", 0, 10),
)
def _slow(parts: SimParts, values: Values, _rng: np.random.Generator) -> End:
    return _tamper(parts, lambda frame: _later(frame, values["seconds"]))


@kind(
    "servo.delayed",
    "The servo reports how it was a while ago.",
    seconds=Parameter(0.3, "how long ago, s", 0, 10),
)
def _delayed(parts: SimParts, values: Values, _rng: np.random.Generator) -> End:
    delay = Delay(parts.world.clock, values["seconds"])
    return _distort(parts, lambda memory: memory.set_live(delay.through(memory.live())))


@kind("servo.intermittent", "A loose contact: answers get lost.", rate=share(0.05, "the answers"))
def _intermittent(parts: SimParts, values: Values, rng: np.random.Generator) -> End:
    return _tamper(parts, lambda frame: None if rng.random() < values["rate"] else frame)


# -- its line ---------------------------------------------------------------------------------------------------------


@kind("crc_flip", "Single bits of the servo's answers flip on the line.", rate=share(0.1, "the answers"))
def _crc_flip(parts: SimParts, values: Values, rng: np.random.Generator) -> End:
    def flip(frame: Frame) -> Frame:
        if rng.random() >= values["rate"]:
            return frame
        data = bytearray(frame.data)
        data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
        return replace(frame, data=bytes(data))

    return _tamper(parts, flip)


@kind(
    "late_reply",
    "Answers come after the host has given them up, while it waits for the next one.",
    rate=share(0.1, "the answers"),
    seconds=Parameter(0.05, "how late, s", 0, 10),
)
def _late_reply(parts: SimParts, values: Values, rng: np.random.Generator) -> End:
    return _tamper(parts, lambda frame: _later(frame, values["seconds"]) if rng.random() < values["rate"] else frame)


@kind(
    "babble",
    "Random bytes on the line all the time: an open line, another master.",
    period=Parameter(0.004, "from one burst of 8 bytes to the next, s", 0.0005, 10),
)
def _babble(parts: SimParts, values: Values, rng: np.random.Generator) -> End:
    bus, adapter = parts.servo_bus, parts.adapter
    return repeatedly(parts.world.clock, values["period"], lambda: bus.disturb(rng.bytes(8), adapter.baudrate))


@kind("echo", "The adapter hears what it sends itself.")
def _echo(parts: SimParts, _values: Values, _rng: np.random.Generator) -> End:
    parts.servo_bus.echo = True
    return lambda: setattr(parts.servo_bus, "echo", False)


@kind("unplug", "The servo's USB adapter is pulled out of the computer; put in again, it must be opened anew.")
def _unplug(parts: SimParts, _values: Values, _rng: np.random.Generator) -> End:
    parts.adapter.unplug()
    return parts.adapter.replug


@kind("duplicate_id", "A second servo with the same id answers on the line.")
def _duplicate_id(parts: SimParts, _values: Values, _rng: np.random.Generator) -> End:
    there = parts.servo
    elsewhere = World(noise=parts.world.noise, seed=parts.world.seed + 1, clock=parts.world.clock)
    twin: SimulatedServo
    if isinstance(there, XSeriesServo):
        twin = XSeriesServo(elsewhere, there.model.name, bus_id=there.bus_id, baudrate=there.baudrate)
    else:
        twin = Ax12Servo(elsewhere, bus_id=there.bus_id, baudrate=there.baudrate)
    parts.servo_bus.attach(twin)
    return lambda: parts.servo_bus.detach(twin)


@kind("wrong_model", "Another model answers at the servo's id.")
def _wrong_model(parts: SimParts, _values: Values, _rng: np.random.Generator) -> End:
    memory = parts.servo.memory
    number = memory["Model Number"]
    memory["Model Number"] = _ANOTHER if number == _OTHER_MODEL else _OTHER_MODEL
    return lambda: memory.__setitem__("Model Number", number)


# -- its supply, load and heat ----------------------------------------------------------------------------------------


@kind(
    "brownout",
    "The servo's supply breaks down; below 4.5 V the servo resets.",
    volts=Parameter(4.0, "what is left, V", 0, 30),
)
def _brownout(parts: SimParts, values: Values, _rng: np.random.Generator) -> End:
    servo, volts = parts.servo, values["volts"]
    if volts < LOWEST_SUPPLY_V:
        servo.power_off()
    servo.set_voltage(volts)

    def restore() -> None:
        servo.set_voltage(servo.model.supply_v)
        servo.power_on()

    return restore


@kind("overload", "The servo shuts itself down for overload; only a reboot brings it back.")
def _overload(parts: SimParts, _values: Values, _rng: np.random.Generator) -> End:
    parts.servo.fail(OVERLOAD_ERROR)
    return lambda: None


@kind(
    "overheat",
    "The servo's case is hot; above its limit it shuts itself down until it is rebooted.",
    celsius=Parameter(85.0, "temperature of the case, °C", -20, 150),
)
def _overheat(parts: SimParts, values: Values, _rng: np.random.Generator) -> End:
    cool_c = parts.servo.motor.temperature_c(0.0)
    parts.servo.set_temperature(values["celsius"])
    return lambda: parts.servo.set_temperature(cool_c)


@kind("watchdog_trip", "The servo's Bus Watchdog trips while the table turns, as after a pause of the host.")
def _watchdog_trip(parts: SimParts, _values: Values, _rng: np.random.Generator) -> End:
    parts.servo.trip_watchdog()
    return lambda: None


# -- its gears and the platter ----------------------------------------------------------------------------------------


@kind(
    "backlash",
    "The gears are worn: free play between shaft and platter.",
    degrees=Parameter(4.0, "play, full width, °", 0, 90),
)
def _backlash(parts: SimParts, values: Values, _rng: np.random.Generator) -> End:
    world = parts.world
    noise = world.noise
    world.noise = noise.with_values(backlash_deg=values["degrees"])
    return lambda: setattr(world, "noise", noise)


@kind(
    "slip",
    "The platter slips on the shaft.",
    angle=Parameter(-6.0, "by how much, °", -360, 360),
    seconds=Parameter(0.1, "how long it takes, s", 0.001, 10),
)
def _slip(parts: SimParts, values: Values, _rng: np.random.Generator) -> End:
    parts.world.slip(values["angle"], values["seconds"])
    return lambda: None


@kind("jam", "The shaft is blocked.")
def _jam(parts: SimParts, _values: Values, _rng: np.random.Generator) -> End:
    parts.servo.jam()
    return parts.servo.free
