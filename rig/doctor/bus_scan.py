"""Who answers on a servo bus and on an I2C bus, by questions that change nothing."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from errno import EBUSY, ENXIO, EREMOTEIO

import serial
from dynamixel_sdk import Protocol2PacketHandler
from smbus2 import SMBus

from rig.bench.computer import Computer
from rig.core.clock import Clock
from rig.core.errors import DeviceSilent, RequestRejected
from rig.devices.dynamixel.bus import DynamixelBus
from rig.devices.dynamixel.port import BusBabble, ClockedPort, SerialConnection
from rig.devices.dynamixel.registers import model_numbers

BAUD_RATES = (57_600, 1_000_000, 115_200, 2_000_000, 3_000_000, 4_000_000, 4_500_000, 9_600)
"""What servos of Protocol 2.0 are set to: the factory's first, then by how common they are."""
BAUD_RATES_1 = (1_000_000, 115_200, 57_600, 500_000, 250_000, 200_000, 19_200, 9_600)
"""The same for Protocol 1.0."""

_ANSWER_1_S = 0.02
"""How long a servo of Protocol 1.0 and its adapter take to answer; each id is asked by itself there."""
_PING_ANSWER = 14
_LISTEN_S = 0.05
_STATUS_READS = 8
_STATUS = (120, 27)
"""Realtime Tick to Present Temperature: two servos with one id do not agree on these for long."""


@dataclass(frozen=True, slots=True)
class FoundServo:
    """A servo that answered; ``model`` is None where no control table is known for its number."""

    bus_id: int
    baud: int
    protocol: int
    model: str | None
    model_number: int
    firmware: int

    def __str__(self) -> str:
        name = self.model.replace("_", "-").upper() if self.model else f"unknown model {self.model_number}"
        return f"{name}, firmware {self.firmware}, id {self.bus_id} at {self.baud} baud (protocol {self.protocol}.0)"


@dataclass(frozen=True, slots=True)
class BaudScan:
    """The answers at one baud rate.

    ``duplicate_ids`` are ids that repeatedly answer with broken packets: two servos have the same id. ``noise`` is True
    if bytes came that belong to no id: another baud rate, another master, or a bad connection.
    """

    baud: int
    protocol: int
    servos: tuple[FoundServo, ...] = ()
    duplicate_ids: tuple[int, ...] = ()
    noise: bool = False

    @property
    def anything(self) -> bool:
        return bool(self.servos or self.duplicate_ids)


def scan_servos(
    wire: SerialConnection, clock: Clock, bauds: Sequence[int] = BAUD_RATES, *, protocol: int = 2
) -> Iterator[BaudScan]:
    """Ask at each baud rate who is there, and yield what was heard; at last the wire has the baud rate it had.

    Takes about a second a baud rate, four at 9,600; with Protocol 1.0, where each id is asked, five.

    Raises
    ------
    serial.SerialException, OSError
        The adapter was pulled out.
    """
    before = wire.baudrate
    try:
        for baud in bauds:
            port = ClockedPort(wire, clock)
            try:
                port.setBaudRate(baud)
            except (ValueError, NotImplementedError):  # this adapter has no such rate
                continue
            yield _heard_2(port, baud) if protocol == 2 else _heard_1(port, baud)
    finally:
        with suppress(serial.SerialException, OSError, ValueError):
            wire.baudrate = before


def without_echoes(heard: Sequence[BaudScan], preferred: int) -> list[BaudScan]:
    """Return what was heard at several rates; of a port that has no baud rate, what was heard at one, ``preferred``.

    On a pseudo-terminal, a port in the network or a board that relays bytes the same servos answer whatever the rate.
    """
    said = {frozenset((servo.bus_id, servo.model_number, servo.firmware) for servo in each.servos) for each in heard}
    if len(heard) < 3 or len(said) > 1 or not heard[0].servos:
        return list(heard)
    return [next((each for each in heard if each.baud == preferred), heard[0])]


def spoiled_reads(bus: DynamixelBus, bus_id: int, reads: int = _STATUS_READS) -> int:
    """Return how many of some reads of a servo's status came back spoiled; the bus must not retry by itself."""
    spoiled = 0
    address, size = _STATUS if bus.protocol == 2 else (36, 8)
    for _ in range(reads):
        try:
            bus.read_block(bus_id, address, size)
        except RequestRejected:
            continue
        except DeviceSilent:
            spoiled += 1
    return spoiled


def _heard_2(port: ClockedPort, baud: int) -> BaudScan:
    listening = _Recording(port)
    try:
        answers, _ = Protocol2PacketHandler().broadcastPing(listening)
    except BusBabble:
        return BaudScan(baud, 2, noise=True)
    port.drain()
    if _unasked(port):
        return BaudScan(baud, 2, noise=True)
    servos = [_servo(bus_id, baud, 2, number, firmware) for bus_id, (number, firmware) in sorted(answers.items())]
    bus = DynamixelBus(port, retries=0)
    duplicate_ids = [servo.bus_id for servo in servos if spoiled_reads(bus, servo.bus_id) > _STATUS_READS // 2]
    # The SDK leaves out what it cannot read, and calls that a success. The answers of servos with one id fall into each
    # other: where more bytes came than belong to whole answers, each id is asked by itself.
    rest = len(listening.answered) - _PING_ANSWER * len(answers)
    for bus_id in (bus_id for bus_id in range(253) if rest and bus_id not in answers):
        try:
            head = bus.read_block(bus_id, 0, 7)
        except (RequestRejected, DeviceSilent):
            duplicate_ids += [bus_id] if _spoils(bus, bus_id) else []
        else:  # its answer to all was spoiled, that to the question of its own is not
            servos.append(_servo(bus_id, baud, 2, int.from_bytes(head[:2], "little"), head[6]))
    sound = tuple(servo for servo in servos if servo.bus_id not in duplicate_ids)
    return BaudScan(baud, 2, sound, tuple(sorted(duplicate_ids)), bool(rest) and not duplicate_ids and not sound)


class _Recording(ClockedPort):
    """A port that keeps what came, but for the instruction itself, which some adapters echo."""

    def __init__(self, port: ClockedPort) -> None:
        super().__init__(port.ser, port.clock)
        self._heard = bytearray()
        self._sent = b""

    @property
    def answered(self) -> bytes:
        return bytes(self._heard).removeprefix(self._sent)

    def writePort(self, packet: list[int]) -> int:  # noqa: N802 - the SDK's names
        self._sent = bytes(packet)
        return super().writePort(packet)

    def readPort(self, length: int) -> bytes:  # noqa: N802
        data = super().readPort(length)
        self._heard += data
        return data


def _heard_1(port: ClockedPort, baud: int) -> BaudScan:
    if _unasked(port):
        return BaudScan(baud, 1, noise=True)
    servos = []
    duplicate_ids = []
    bus = DynamixelBus(_Hasty(port), retries=0, protocol=1)
    for bus_id in range(253):
        corrupt = bus.statistics.corrupt
        try:
            head = bus.read_block(bus_id, 0, 3)
        except RequestRejected:
            continue
        except DeviceSilent:
            if bus.statistics.corrupt > corrupt and _spoils(bus, bus_id):
                duplicate_ids.append(bus_id)
            continue
        servos.append(_servo(bus_id, baud, 1, int.from_bytes(head[:2], "little"), head[2]))
    return BaudScan(baud, 1, tuple(servos), tuple(duplicate_ids))


def _unasked(port: ClockedPort) -> bool:
    """Return whether bytes come although nobody was asked: with them every id would seem to answer."""
    end_ns = port.clock.now_ns() + round(_LISTEN_S * 1e9)
    while port.clock.now_ns() < end_ns:
        if port.ser.read(1):
            return True
    return False


class _Hasty(ClockedPort):
    """A port that waits for an answer no longer than a servo and its adapter take."""

    def __init__(self, port: ClockedPort) -> None:
        super().__init__(port.ser, port.clock)

    def setPacketTimeout(self, packet_length: int) -> None:  # noqa: N802 - the SDK's name
        self.setPacketTimeoutMillis(packet_length * self.tx_time_per_byte + 1e3 * _ANSWER_1_S)


def _servo(bus_id: int, baud: int, protocol: int, number: int, firmware: int) -> FoundServo:
    return FoundServo(bus_id, baud, protocol, model_numbers().get(number), number, firmware)


def _spoils(bus: DynamixelBus, bus_id: int, pings: int = 3) -> bool:
    """Return whether something answers an id every time, and never with a whole packet."""
    for _ in range(pings):
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
class Chip:
    """A kind of sensor: where it may be, and the register that says which it is."""

    name: str
    driver: str | None
    addresses: tuple[int, ...]
    register: int
    value: int


CHIPS = (
    Chip("MPU-6050", "mpu6050", (0x68, 0x69), 0x75, 0x68),
    Chip("MPU-6500", None, (0x68, 0x69), 0x75, 0x70),
    Chip("MPU-9250", None, (0x68, 0x69), 0x75, 0x71),
    Chip("MPU-9255", None, (0x68, 0x69), 0x75, 0x73),
    Chip("ICM-20948", None, (0x68, 0x69), 0x00, 0xEA),
    Chip("BNO055", "bno055", (0x28, 0x29), 0x00, 0xA0),
    Chip("LSM6DSOX", None, (0x6A, 0x6B), 0x0F, 0x6C),
)


@dataclass(frozen=True, slots=True)
class FoundImu:
    """Somebody at an address where IMUs are; ``driver`` is None where the rig has none for it, or it is unknown.

    ``trouble`` says what else was found there: an unknown chip, a kernel driver that holds the address.
    """

    bus: str
    address: int
    name: str
    driver: str | None
    trouble: str = ""

    def __str__(self) -> str:
        return f"{self.name} at {self.address:#04x} of {self.bus}" + (f": {self.trouble}" if self.trouble else "")


def scan_imus(computer: Computer, bus: int | str) -> list[FoundImu]:
    """Return who answers at the addresses that IMUs have; no other address is asked, and nothing is written.

    Raises
    ------
    OSError
        The bus cannot be opened, or does not move.
    """
    name = computer.i2c_name(bus)
    found = []
    with SMBus(computer.i2c_path(bus)) as wire:
        for address in sorted({address for chip in CHIPS for address in chip.addresses}):
            said: dict[int, int] = {}
            try:
                for register in sorted({chip.register for chip in CHIPS if address in chip.addresses}):
                    said[register] = wire.read_byte_data(address, register)
            except OSError as error:
                if error.errno == EBUSY:
                    found.append(FoundImu(name, address, "something", None, "a driver of the kernel holds the address"))
                elif error.errno not in (ENXIO, EREMOTEIO):
                    raise
                continue
            chips = [c for c in CHIPS if address in c.addresses and said[c.register] == c.value]
            if chips:
                found.append(FoundImu(name, address, chips[0].name, chips[0].driver))
            else:
                values = ", ".join(f"register {register:#04x} is {value:#04x}" for register, value in said.items())
                found.append(FoundImu(name, address, "unknown chip", None, values))
    return found
