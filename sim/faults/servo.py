"""Simulated faults of the servo, its gears and its bus."""

from collections import deque
from dataclasses import replace

from rig.core.clock import seconds_between
from sim.devices import SimDevices
from sim.faults.kind import End, Parameter, Rng, added, repeatedly, share, simulated_fault, switched
from sim.servo import SentBytes, SimServo
from sim.servo.control_table import Memory
from sim.servo.device import OVERLOAD_ERROR
from sim.world import World

LOWEST_SUPPLY_V = 4.5  # below this voltage the servo's controller resets. The e-manual states no value.
_OTHER_MODEL = 1020  # model Number of an XM430-W350
_XL430_MODEL = 1060


def _later(frame: SentBytes, seconds: float) -> SentBytes:
    return replace(frame, start_ns=frame.start_ns + round(seconds * 1e9))


# -- the device -------------------------------------------------------------------------------------------------------


@simulated_fault("servo.off", "The servo loses its supply. When it starts again, its count of revolutions is lost.")
def _off(devices: SimDevices, _rng: Rng) -> End:
    devices.servo.power_off()
    return devices.servo.power_on


@simulated_fault("servo.stuck", "The servo's status registers do not change while the shaft moves.")
def _stuck(devices: SimDevices, _rng: Rng) -> End:
    readings: list[bytes] = []

    def hold(memory: Memory) -> None:
        readings.append(memory.live())
        memory.set_live(readings[0])

    return added(devices.servo.distortions, hold)


simulated_fault("servo.garbage", "The servo's status registers contain random bytes, with a valid CRC.")(
    lambda devices, rng: added(devices.servo.distortions, lambda memory: memory.set_live(rng.bytes(len(memory.live()))))
)


simulated_fault(
    "servo.wrong",
    "The encoder's magnet slips on the shaft, so the servo goes to wrong angles.",
    angle=Parameter(5.0, "slip, °", -90, 90),
)(lambda devices, _, angle: devices.servo.slip_encoder(angle))
simulated_fault(
    "servo.slow",
    "Each answer is late but within the timeout, as with a USB latency timer of 16 ms.",
    seconds=Parameter(0.01, "delay, s", 0, 10),
)(lambda devices, _, seconds: added(devices.servo_bus.filters, lambda frame: _later(frame, seconds)))


@simulated_fault(
    "servo.delayed", "The servo reports old readings.", seconds=Parameter(0.3, "age of the readings, s", 0, 10)
)
def _delayed(devices: SimDevices, _rng: Rng, seconds: float) -> End:
    clock, readings = devices.world.clock, deque[tuple[int, bytes]]()

    def age(memory: Memory) -> None:
        """Show the newest reading that is old enough, or else the oldest."""
        readings.append((clock.now_ns(), memory.live()))
        while len(readings) > 1 and seconds_between(readings[1][0], clock.now_ns()) >= seconds:
            readings.popleft()
        memory.set_live(readings[0][1])

    return added(devices.servo.distortions, age)


simulated_fault("servo.intermittent", "A contact is loose. Some answers are lost.", rate=share(0.05, "answers"))(
    lambda devices, rng, rate: added(devices.servo_bus.filters, lambda frame: None if rng.random() < rate else frame)
)


# -- its bus ----------------------------------------------------------------------------------------------------------


@simulated_fault("crc_flip", "Single bits of some answers flip on the servo bus.", rate=share(0.1, "answers"))
def _crc_flip(devices: SimDevices, rng: Rng, rate: float) -> End:
    def flip(frame: SentBytes) -> SentBytes:
        if rng.random() >= rate:
            return frame
        data = bytearray(frame.data)
        data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
        return replace(frame, data=bytes(data))

    return added(devices.servo_bus.filters, flip)


@simulated_fault(
    "late_reply",
    "Some answers arrive after the timeout, while the computer waits for the next answer.",
    rate=share(0.1, "answers"),
    seconds=Parameter(0.05, "delay, s", 0, 10),
)
def _late_reply(devices: SimDevices, rng: Rng, seconds: float, rate: float) -> End:
    return added(
        devices.servo_bus.filters,
        lambda frame: _later(frame, seconds) if rng.random() < rate else frame,
    )


@simulated_fault(
    "duplicate_reply",
    "Some answers arrive a second time, later, while the computer waits for another answer.",
    rate=share(0.2, "answers"),
    seconds=Parameter(0.04, "delay of the second one, s", 0, 10),
)
def _duplicate_reply(devices: SimDevices, rng: Rng, rate: float, seconds: float) -> End:
    bus, clock = devices.servo_bus, devices.world.clock

    def repeat(frame: SentBytes) -> SentBytes:
        if rng.random() < rate:
            at_ns = frame.start_ns + round(seconds * 1e9)
            clock.call_at(max(at_ns, clock.now_ns()), lambda: bus.disturb(frame.data, frame.baudrate))
        return frame

    return added(devices.servo_bus.filters, repeat)


@simulated_fault(
    "babble",
    "Random bytes appear on the servo bus, as from an open wire or a second controller.",
    period=Parameter(0.004, "time between bursts of 8 bytes, s", 0.0005, 10),
)
def _babble(devices: SimDevices, rng: Rng, period: float) -> End:
    bus, adapter = devices.servo_bus, devices.adapter
    return repeatedly(devices.world.clock, period, lambda: bus.disturb(rng.bytes(8), adapter.baudrate))


simulated_fault("echo", "The adapter receives its own bytes.")(
    lambda devices, _: switched(devices.servo_bus, "echo", True, False)
)


@simulated_fault("unplug", "The servo's USB adapter is unplugged. After it is plugged in, it must be opened again.")
def _unplug(devices: SimDevices, _rng: Rng) -> End:
    devices.adapter.unplug()
    return devices.adapter.replug


@simulated_fault("duplicate_id", "A second servo with the same id answers.")
def _duplicate_id(devices: SimDevices, _rng: Rng) -> End:
    first = devices.servo
    world = World(noise=devices.world.noise, seed=devices.world.seed + 1, clock=devices.world.clock)
    twin = SimServo(world, first.model.name, bus_id=first.bus_id, baudrate=first.baudrate)
    devices.servo_bus.attach(twin)
    return lambda: devices.servo_bus.detach(twin)


@simulated_fault("wrong_model", "A servo of another model answers at the id.")
def _wrong_model(devices: SimDevices, _rng: Rng) -> End:
    memory = devices.servo.memory
    number = memory["Model Number"]
    memory["Model Number"] = _XL430_MODEL if number == _OTHER_MODEL else _OTHER_MODEL
    return lambda: memory.__setitem__("Model Number", number)


# -- its supply, load and heat ----------------------------------------------------------------------------------------


@simulated_fault(
    "brownout",
    "The servo's supply voltage drops. Below 4.5 V the servo resets.",
    volts=Parameter(4.0, "supply voltage, V", 0, 30),
)
def _brownout(devices: SimDevices, _rng: Rng, volts: float) -> End:
    servo = devices.servo
    if volts < LOWEST_SUPPLY_V:
        servo.power_off()
    servo.set_voltage(volts)

    def restore() -> None:
        servo.set_voltage(servo.model.supply_v)
        servo.power_on()

    return restore


simulated_fault("overload", "The servo shuts down because of an overload, until it is rebooted.")(
    lambda devices, _: devices.servo.fail(OVERLOAD_ERROR)
)


@simulated_fault(
    "overheat",
    "The servo is hot. Above its limit it shuts down until it is rebooted.",
    celsius=Parameter(85.0, "temperature of the case, °C", -20, 150),
)
def _overheat(devices: SimDevices, _rng: Rng, celsius: float) -> End:
    cool_c = devices.servo.motor.temperature_c(0.0)
    devices.servo.set_temperature(celsius)
    return lambda: devices.servo.set_temperature(cool_c)


simulated_fault("watchdog_trip", "The servo's Bus Watchdog stops the table, as after a pause of the computer.")(
    lambda devices, _: devices.servo.trip_watchdog()
)


# -- its gears and the platter ----------------------------------------------------------------------------------------


@simulated_fault(
    "backlash",
    "The gears are worn and have a large backlash.",
    degrees=Parameter(4.0, "backlash, full width, °", 0, 90),
)
def _backlash(devices: SimDevices, _rng: Rng, degrees: float) -> End:
    world = devices.world
    noise = world.noise
    world.noise = noise.with_values(backlash_deg=degrees)
    return lambda: setattr(world, "noise", noise)


simulated_fault(
    "slip",
    "The platter slips on the shaft.",
    angle=Parameter(-6.0, "slip, °", -360, 360),
    seconds=Parameter(0.1, "duration of the slip, s", 0.001, 10),
)(lambda devices, _, angle, seconds: devices.world.slip(angle, seconds))


@simulated_fault(
    "friction",
    "Friction and a steady load hold the table. It rests short of its goal, outside the servo's in-position window.",
    friction=Parameter(0.05, "friction, as a share of the stall torque", 0, 1),
    load=Parameter(0.005, "steady load that rotates clockwise, as a share of the stall torque", -1, 1),
)
def _friction(devices: SimDevices, _rng: Rng, friction: float, load: float) -> End:
    devices.servo.motor.set_friction(friction, load)
    return lambda: devices.servo.motor.set_friction()


@simulated_fault("jam", "The shaft is blocked.")
def _jam(devices: SimDevices, _rng: Rng) -> End:
    devices.servo.jam()
    return devices.servo.free
