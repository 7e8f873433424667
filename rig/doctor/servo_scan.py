"""Find servos at any baud rate, which changes nothing; and change the id and baud rate of one that is alone.

A change needs a servo that is alone on its bus. Its torque is off, and the change is verified afterwards.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace

import serial
from dynamixel_sdk import Protocol2PacketHandler

from rig.core.clock import Clock
from rig.core.errors import DeviceNotFound, DeviceSilent, RequestRejected, SeveralServos, UsageError
from rig.core.next_steps import Do
from rig.devices.dynamixel.bus import DynamixelBus
from rig.devices.dynamixel.port import BusBabble, ClockedPort, SerialConnection
from rig.devices.dynamixel.registers import (
    ControlTable,
    control_table,
    model_of,
    model_row,
    obstacle,
    require_driven,
)
from rig.doctor.examination import DoctorContext

# a scan of all takes long, so the usual ones come first
BAUD_RATES = (57_600, 1_000_000, 115_200, 2_000_000, 3_000_000, 4_000_000, 4_500_000, 9_600)
"""Baud rates: the factory setting first, then in order of frequency."""
BAUD_CODES = {9_600: 0, 57_600: 1, 115_200: 2, 1_000_000: 3, 2_000_000: 4, 3_000_000: 5, 4_000_000: 6, 4_500_000: 7}
"""Values of Baud Rate (e-manual)."""
MAX_ID = 252  # 253 is reserved, and 254 is the broadcast
_PING_ANSWER = 14
_LISTEN_S = 0.05  # longer than an answer at the lowest rate; only a device that talks by itself sends in this time
_SETTLE_S = 0.05  # time that a servo needs before it answers at a new rate
# two servos with one id collide in most readings, a bad cable in few: more than half of these tells them apart
_STATUS_READS = 8
_MOST_DUPLICATE_IDS = 4  # if more ids collide, an adapter or a loose contact adds bytes after each request
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


def scan_servos(
    wire: SerialConnection, clock: Clock, bauds: Sequence[int] = BAUD_RATES, preferred: int = BAUD_RATES[0]
) -> list[BaudScan]:
    """Return the answers at each baud rate; afterwards the port has its old baud rate again.

    A duplicate id ends the scan. Takes about one second per baud rate, four at 9,600 baud. A pseudo-terminal, a network
    port or a board that relays bytes has no baud rate: the same servos answer at every one, and only the scan at the
    ``preferred`` rate is returned.

    Raises `serial.SerialException`, `OSError`: the adapter was unplugged.
    """
    before = wire.baudrate
    scans: list[BaudScan] = []
    try:
        for baud in bauds:
            port = ClockedPort(wire, clock)
            try:
                port.setBaudRate(baud)
            except (ValueError, NotImplementedError):  # the adapter does not support this rate
                continue
            scans.append(_scan(port, baud))
            if scans[-1].duplicate_ids:  # nothing can be set before one of the two is unplugged
                return scans
    finally:
        with suppress(serial.SerialException, OSError, ValueError):
            wire.baudrate = before
    # Equal answers at every rate are echoes of one; few rates prove nothing.
    answers = {frozenset((servo.bus_id, servo.model_number, servo.firmware) for servo in each.servos) for each in scans}
    if len(scans) < 3 or len(answers) > 1 or not scans[0].servos:
        return scans
    return [next((each for each in scans if each.baud == preferred), scans[0])]


def _scan(port: ClockedPort, baud: int) -> BaudScan:
    # Who answers to a broadcast, and how many bytes come.
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
    bus = DynamixelBus(port, retries=0)  # a repetition would hide a collision
    duplicate_ids = [servo.bus_id for servo in servos if _collides(bus, servo.bus_id, servo.model)]
    # The SDK skips what it cannot read, and reports success. Answers of servos with the same id collide: if more bytes
    # came than belong to complete answers, ask each id separately.
    rest = len(listening.answered) - _PING_ANSWER * len(answers)
    for bus_id in (bus_id for bus_id in range(MAX_ID + 1) if rest and bus_id not in answers):
        if len(duplicate_ids) > _MOST_DUPLICATE_IDS:
            break
        corrupt = bus.statistics.corrupt
        try:
            head = bus.read_block(bus_id, 0, 7)
        except (RequestRejected, DeviceSilent):
            if bus.statistics.corrupt > corrupt and _collides(bus, bus_id):
                duplicate_ids.append(bus_id)
        else:  # its answer to the broadcast was corrupt, this one is not
            number = int.from_bytes(head[:2], "little")
            servos.append(FoundServo(bus_id, baud, model_of(number), number, head[6]))
    sound = tuple(servo for servo in servos if servo.bus_id not in duplicate_ids)
    if len(duplicate_ids) > _MOST_DUPLICATE_IDS:
        return BaudScan(baud, sound, noise=True)
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


def _collides(bus: DynamixelBus, bus_id: int, model: str | None = None) -> bool:
    """Return whether most answers of an id are corrupt: two servos have it."""
    row = model_row(model) if model else None
    address = next((address for address, _, name in row.registers if name == _STATUS), 120) if row else 120
    before = bus.statistics.corrupt
    for _ in range(_STATUS_READS):
        with suppress(RequestRejected, DeviceSilent):
            bus.read_block(bus_id, address, _STATUS_SIZE)
    return bus.statistics.corrupt - before > _STATUS_READS // 2


# -- one servo that is alone on its bus -------------------------------------------------------------------------------


class SingleServo:
    """A servo that is alone on its bus: where it was found, its bus, and its control table."""

    def __init__(self, found: FoundServo, wire: SerialConnection, clock: Clock) -> None:
        require_driven(found.model_number, found.bus_id)
        assert found.model is not None
        wire.baudrate = found.baud
        self.found, self._wire, self._clock = found, wire, clock
        self.bus = DynamixelBus(ClockedPort(wire, clock))
        self.table: ControlTable = control_table(found.model, found.firmware)

    def set_id(self, new: int) -> None:
        """Change the id of the servo, to one from 0 to `MAX_ID`.

        Raises `RequestRejected`: the servo did not accept the id; it answers to the old one.
        """
        self._torque_off()
        self._write("ID", new)
        self._verify(new, "ID", new, f"the id {new}")
        self.found = replace(self.found, bus_id=new)

    def set_baud(self, rate: int) -> None:
        """Change the baud rate of the servo and of the port.

        Raises `UsageError`: the model or the adapter does not support the rate. `RequestRejected`: the servo did not
        accept the rate; it answers at the old one.
        """
        codes = baud_codes(self.table)
        if rate not in codes:
            known = ", ".join(map(str, sorted(codes)))
            raise UsageError(f"This servo has no baud rate {rate}.", next_step=f"Choose one of {known}.")
        # The adapter is asked before the servo is changed, which could not be reached any more.
        old = self.found.baud
        try:
            self._wire.baudrate = rate
            self._wire.baudrate = old
        except (serial.SerialException, OSError, ValueError) as error:
            raise UsageError(
                f"The serial adapter has no baud rate {rate}.",
                next_step="Choose a lower one.",
                evidence={"reason": str(error)},
            ) from error
        self._torque_off()
        self._write("Baud Rate", codes[rate])
        self.bus.port.setBaudRate(rate)
        self._clock.sleep(_SETTLE_S)
        try:
            self._verify(self.found.bus_id, "Baud Rate", codes[rate], f"{rate} baud")
        except RequestRejected:
            self.bus.port.setBaudRate(old)
            raise
        self.found = replace(self.found, baud=rate)

    def _torque_off(self) -> None:
        self._write("Torque Enable", 0)
        if self.bus.read(self.found.bus_id, self.table["Torque Enable"]):
            raise RequestRejected(
                f"Servo {self.found.bus_id} does not switch its torque off.",
                next_step="Switch its supply off and on, then try again.",
            )

    def _write(self, name: str, value: int) -> None:
        # It may be set to answer reads only.
        answered = self.bus.read(self.found.bus_id, self.table["Status Return Level"]) == 2
        self.bus.write(self.found.bus_id, self.table[name], value, answered=answered)

    def _verify(self, bus_id: int, name: str, value: int, what: str) -> None:
        self._clock.sleep(_SETTLE_S)
        try:
            kept = self.bus.read(bus_id, self.table[name]) == value
        except DeviceSilent:
            kept = False
        if not kept:
            raise RequestRejected(
                f"The servo did not accept {what}.",
                next_step=("Switch its supply off and on.", Do.FIND()),
                evidence={"register": name, "wrote": value, "id": bus_id},
            )


def baud_codes(table: ControlTable) -> dict[int, int]:
    """Return the baud rates that a model can be set to, each with its register value."""
    fastest = 4_000_000 if table.row.name.startswith(("xl330", "xc330")) else 4_500_000
    return {rate: code for rate, code in BAUD_CODES.items() if rate <= fastest}


@contextmanager
def single_servo(context: DoctorContext) -> Iterator[SingleServo]:
    """Yield the only servo on the configured port, found at any id and baud rate; the port is opened exclusively.

    Raises `DeviceNotFound`: no servo answers at any baud rate. `SeveralServos`: several servos answer, or two have the
    same id. `DeviceMismatch`: the rig cannot drive its model. `BenchBusy`: another program uses the bench or the port.
    """
    config, clock = context.config.servo, context.computer.clock
    context.require_free()
    context.computer.require_unused(config.port)
    wire = context.computer.open_serial(config.port, config.baud)
    try:
        # A second servo at another rate would answer as soon as the rates are equal.
        yield SingleServo(_only_one(scan_servos(wire, clock, preferred=config.baud), config.port), wire, clock)
    finally:
        wire.close()


def _only_one(scans: list[BaudScan], port: str) -> FoundServo:
    ids = list(scans[-1].duplicate_ids) if scans else []
    found = [servo for scan in scans for servo in scan.servos]
    if ids or len(found) > 1:
        several = f"There are {len(found)} servos on {port}."
        twice = f"Two servos answer at once to id {', '.join(map(str, ids))} at {scans[-1].baud} baud."
        raise SeveralServos(
            twice if ids else several,
            next_step="Unplug all other servos, then try again.",
            evidence={"ids": ids, "servos": list(map(str, found))},
        )
    if not found:
        raise DeviceNotFound(
            f"No servo answers on {port} at any baud rate.",
            next_step="Check the servo's cable and switch on its supply (its LED blinks once), then try again.",
            evidence={"port": port},
        )
    return found[0]
