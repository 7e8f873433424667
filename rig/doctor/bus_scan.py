"""Scan servo buses and I2C buses for devices; the scan changes nothing."""

import os
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from errno import EBUSY

import serial
from dynamixel_sdk import Protocol2PacketHandler
from smbus2 import SMBus

from rig.bench.computer import Computer
from rig.config.imus import imu_kinds
from rig.core.clock import Clock
from rig.core.errors import DeviceSilent, RequestRejected
from rig.devices.dynamixel.bus import DynamixelBus
from rig.devices.dynamixel.port import BusBabble, ClockedPort, SerialConnection
from rig.devices.dynamixel.registers import model_of, model_row, obstacle
from rig.devices.i2c import NO_DEVICE, STUCK, controller_hangs, unbind_command
from rig.doctor.context import DoctorContext
from rig.doctor.finding import Finding, FindingCode

# a scan of all takes long, so the usual ones come first
BAUD_RATES = (57_600, 1_000_000, 115_200, 2_000_000, 3_000_000, 4_000_000, 4_500_000, 9_600)
"""Baud rates: the factory setting first, then in order of frequency."""
_PING_ANSWER = 14
_LISTEN_S = 0.05  # longer than an answer at the lowest rate; only a device that talks by itself sends in this time
# two servos with one id collide in most readings, a bad cable in few: more than half of these tells them apart
_STATUS_READS = 8
_STATUS, _STATUS_SIZE = "Realtime Tick", 27  # to Present Temperature: servos with the same id soon differ in these


@dataclass(frozen=True, slots=True)
class FoundServo:
    """A servo that answered; ``model`` is None for an unknown number; ``obstacle`` as in `registers.obstacle`."""

    bus_id: int
    baud: int
    model: str | None
    model_number: int
    firmware: int

    @property
    def obstacle(self) -> tuple[str, str] | None:
        return obstacle(self.model_number)

    def __str__(self) -> str:
        name = self.model.replace("_", "-").upper() if self.model else f"unknown model {self.model_number}"
        return f"{name}, firmware {self.firmware}, id {self.bus_id} at {self.baud} baud"


@dataclass(frozen=True, slots=True)
class BaudScan:
    """The answers at one baud rate.

    ``duplicate_ids`` are ids that repeatedly answer with broken packets: two servos have the same id. ``noise`` is True
    if bytes came that belong to no id: another baud rate, another master, or a bad connection.
    """

    baud: int
    servos: tuple[FoundServo, ...] = ()
    duplicate_ids: tuple[int, ...] = ()
    noise: bool = False

    @property
    def answered(self) -> bool:
        return bool(self.servos or self.duplicate_ids)


def scan_servos(wire: SerialConnection, clock: Clock, bauds: Sequence[int] = BAUD_RATES) -> Iterator[BaudScan]:
    """Scan each baud rate and yield the answers; afterwards the port has its old baud rate again.

    Takes about one second per baud rate, four at 9,600 baud.

    Raises `serial.SerialException`, `OSError`: the adapter was unplugged.
    """
    before = wire.baudrate
    try:
        for baud in bauds:
            port = ClockedPort(wire, clock)
            try:
                port.setBaudRate(baud)
            except (ValueError, NotImplementedError):  # the adapter does not support this rate
                continue
            yield _scan(port, baud)
    finally:
        with suppress(serial.SerialException, OSError, ValueError):
            wire.baudrate = before


def scan_rates(
    context: DoctorContext, wire: SerialConnection, rates: Iterable[int], port: str
) -> Generator[str, None, list[BaudScan]]:
    """Scan at each baud rate, yield a text before each, and return the scans `without_echoes`.

    A duplicate id ends the scan: then it is the last one.
    """
    scans: list[BaudScan] = []
    for rate in rates:
        yield f"{port}: scanning at {rate} baud ..."
        scans += scan_servos(wire, context.computer.clock, [rate])
        if scans and scans[-1].duplicate_ids:
            return scans
    return without_echoes(scans, context.config.servo.baud)


def without_echoes(scans: Sequence[BaudScan], preferred: int) -> list[BaudScan]:
    """Return the scans; for a port without a baud rate, only that at the ``preferred`` rate.

    On a pseudo-terminal, a network port or a board that relays bytes, the same servos answer at every rate.
    """
    answers = {frozenset((servo.bus_id, servo.model_number, servo.firmware) for servo in each.servos) for each in scans}
    if len(scans) < 3 or len(answers) > 1 or not scans[0].servos:
        return list(scans)
    return [next((each for each in scans if each.baud == preferred), scans[0])]


def corrupt_reads(bus: DynamixelBus, bus_id: int, model: str | None = None) -> int:
    """Return how many reads of a servo's status came back corrupt; the bus must not retry."""
    corrupt = 0
    row = model_row(model) if model else None
    places = {name: address for address, _, name in row.registers} if row else {}
    address = places.get(_STATUS, 120)
    for _ in range(_STATUS_READS):
        try:
            bus.read_block(bus_id, address, _STATUS_SIZE)
        except RequestRejected:
            continue
        except DeviceSilent:
            corrupt += 1
    return corrupt


def _scan(port: ClockedPort, baud: int) -> BaudScan:
    listening = _Recording(port)
    try:
        answers, _ = Protocol2PacketHandler().broadcastPing(listening)
    except BusBabble:
        return BaudScan(baud, noise=True)
    port.drain()
    if _babbles(port):
        return BaudScan(baud, noise=True)
    servos = [
        FoundServo(bus_id, baud, model_of(number), number, firmware)
        for bus_id, (number, firmware) in sorted(answers.items())
    ]
    bus = DynamixelBus(port, retries=0)
    duplicate_ids = [
        servo.bus_id for servo in servos if corrupt_reads(bus, servo.bus_id, servo.model) > _STATUS_READS // 2
    ]
    # The SDK skips what it cannot read, and reports success. Answers of servos with the same id collide: if more bytes
    # came than belong to complete answers, ask each id separately.
    rest = len(listening.answered) - _PING_ANSWER * len(answers)
    for bus_id in (bus_id for bus_id in range(253) if rest and bus_id not in answers):
        try:
            head = bus.read_block(bus_id, 0, 7)
        except (RequestRejected, DeviceSilent):
            duplicate_ids += [bus_id] if _answers_corrupt(bus, bus_id) else []
        else:  # its answer to the broadcast was corrupt, this one is not
            number = int.from_bytes(head[:2], "little")
            servos.append(FoundServo(bus_id, baud, model_of(number), number, head[6]))
    sound = tuple(servo for servo in servos if servo.bus_id not in duplicate_ids)
    return BaudScan(baud, sound, tuple(sorted(duplicate_ids)), bool(rest) and not duplicate_ids and not sound)


class _Recording(ClockedPort):
    """A port that records the received bytes, without the instruction that some adapters echo."""

    def __init__(self, port: ClockedPort) -> None:
        super().__init__(port.ser, port.clock)
        self._received = bytearray()
        self._sent = b""

    @property
    def answered(self) -> bytes:
        return bytes(self._received).removeprefix(self._sent)

    def writePort(self, packet: list[int]) -> int:  # noqa: N802 - the SDK's names
        self._sent = bytes(packet)
        return super().writePort(packet)

    def readPort(self, length: int) -> bytes:  # noqa: N802
        data = super().readPort(length)
        self._received += data
        return data


def _babbles(port: ClockedPort) -> bool:
    """Return whether bytes come without a request: they would make every id seem to answer."""
    end_ns = port.clock.now_ns() + round(_LISTEN_S * 1e9)
    while port.clock.now_ns() < end_ns:
        if port.ser.read(1):
            return True
    return False


def _answers_corrupt(bus: DynamixelBus, bus_id: int) -> bool:
    """Return whether each of three pings of an id gets a corrupt answer."""
    for _ in range(3):
        corrupt = bus.statistics.corrupt
        try:
            bus.ping(bus_id)
        except RequestRejected:
            return False
        except DeviceSilent:
            if bus.statistics.corrupt == corrupt:
                return False
        else:
            return False
    return True


# -- I2C --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class FoundImu:
    """A device at an IMU address; ``driver``, the ``imu.model``, is None if there is no driver, or if it is unknown.

    ``note`` has more about it: the note of its row, or registers of an unknown chip. ``kernel_driver`` names the driver
    that uses the address, "" if its name is not known. ``errno`` is the error of the bus at the address; the controller
    ``hangs`` if this is the only answer of the whole bus.
    """

    bus: str
    address: int
    name: str
    driver: str | None
    note: str = ""
    kernel_driver: str | None = None
    errno: int = 0
    hangs: bool = False

    def __str__(self) -> str:
        return f"{self.name} at {self.address:#04x} of {self.bus}" + (f": {self.note}" if self.note else "")


def unusable_address(found: FoundImu) -> Finding | None:
    """Return why a program cannot use an address: a kernel driver uses it, or the bus fails; None if it can."""
    if found.kernel_driver is not None:
        place = {"driver": found.kernel_driver or "(unknown)", "bus": found.bus, "address": found.address}
        command = unbind_command(found.bus.removeprefix("/dev/"), found.address, found.kernel_driver)
        fix = command if found.kernel_driver else "ls -l /sys/bus/i2c/devices/*/driver"
        return FindingCode.KERNEL_DRIVER(fix, **place)
    if not found.errno:
        return None
    code = FindingCode.I2C_STUCK if found.errno in STUCK else FindingCode.I2C_FAILED
    code = FindingCode.I2C_HANGS if found.hangs else code
    reason = os.strerror(found.errno)
    return code(bus=found.bus, address=found.address, reason=reason, errno=found.errno)


def use_another_imu() -> str:
    """Return the next step for a sensor without a driver."""
    return f"Use one of these sensors: {', '.join(row.name for row in imu_kinds().values() if row.driver)}"


def scan_imus(computer: Computer, bus: int | str) -> list[FoundImu]:
    """Return the devices that answer at IMU addresses; no other address is asked, and nothing is written.

    An address at which the bus fails is also returned, with the error's number: the others are asked nevertheless.

    Raises `OSError`: the bus cannot be opened.
    """
    name = computer.i2c_name(bus)
    rows = imu_kinds().values()
    found, failures, path = [], [], computer.i2c_path(bus)
    with SMBus(path) as wire:
        for address in sorted({address for row in rows for address in row.addresses}):
            said: dict[int, int] = {}
            try:
                for register in sorted({row.register for row in rows if address in row.addresses}):
                    said[register] = wire.read_byte_data(address, register)
            except OSError as error:
                number = error.errno or 0
                failures.append(number)
                if number == EBUSY:
                    driver = computer.i2c_driver(bus, address) or ""
                    found.append(FoundImu(name, address, "unknown device", None, kernel_driver=driver))
                elif number not in NO_DEVICE:
                    found.append(FoundImu(name, address, "unknown device", None, errno=number))
                continue
            here = [row for row in rows if address in row.addresses and said[row.register] in row.identities]
            if here:
                found.append(
                    FoundImu(name, address, here[0].name, here[0].key if here[0].driver else None, here[0].note)
                )
            else:
                values = ", ".join(f"register {register:#04x} is {value:#04x}" for register, value in said.items())
                found.append(FoundImu(name, address, "unknown chip", None, values))
    hangs = all(one.errno for one in found) and controller_hangs(path, failures)
    return [replace(one, hangs=hangs) for one in found]
