"""Change a servo's id and baud rate: only if it is alone on its bus, with the torque off, and verified afterwards."""

from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import replace

import serial

from rig.core.errors import DeviceNotFound, DeviceSilent, RequestRejected, SeveralServos, UsageError
from rig.core.next_steps import Do
from rig.devices.dynamixel.bus import DynamixelBus
from rig.devices.dynamixel.port import ClockedPort, SerialConnection
from rig.devices.dynamixel.registers import ControlTable, control_table, require_driven
from rig.doctor.bus_scan import BAUD_RATES, BaudScan, FoundServo, scan_rates
from rig.doctor.context import DoctorContext

BAUD_CODES = {9_600: 0, 57_600: 1, 115_200: 2, 1_000_000: 3, 2_000_000: 4, 3_000_000: 5, 4_000_000: 6, 4_500_000: 7}
"""Values of Baud Rate (e-manual)."""
MAX_ID = 252  # 253 is reserved, and 254 is the broadcast
_SETTLE_S = 0.05  # time that a servo needs before it answers at a new rate


class SingleServo:
    """The only servo on a bus, found at any id and baud rate.

    Raises `DeviceNotFound`: no servo answers at any baud rate. `SeveralServos`: several servos answer, or two have the
    same id. `DeviceMismatch`: the rig cannot drive its model.
    """

    def __init__(
        self, context: DoctorContext, wire: SerialConnection, progress: Callable[[str], None] = lambda _: None
    ) -> None:
        self._wire = wire
        self._clock = context.computer.clock
        self.found = _find_only_servo(context, wire, progress)
        require_driven(self.found.model_number, self.found.bus_id)
        assert self.found.model is not None
        wire.baudrate = self.found.baud
        self.bus = DynamixelBus(ClockedPort(wire, self._clock))
        self.table: ControlTable = control_table(self.found.model, self.found.firmware)

    def set_id(self, new: int) -> None:
        """Change the id of the servo.

        Raises `UsageError`: the id is out of range. `RequestRejected`: the servo did not accept the id; it answers to
        the old one.
        """
        if not 0 <= new <= MAX_ID:
            raise UsageError(f"No servo has the id {new}.", next_step=f"Choose an id from 0 to {MAX_ID}.")
        old = self.found.bus_id
        self._torque_off()
        self.bus.write(old, self.table["ID"], new, answered=self._answered())
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
        self.bus.write(self.found.bus_id, self.table["Baud Rate"], codes[rate], answered=self._answered())
        self.bus.port.setBaudRate(rate)
        self._clock.sleep(_SETTLE_S)
        try:
            self._verify(self.found.bus_id, "Baud Rate", codes[rate], f"{rate} baud")
        except RequestRejected:
            self.bus.port.setBaudRate(old)
            raise
        self.found = replace(self.found, baud=rate)

    def _torque_off(self) -> None:
        self.bus.write(self.found.bus_id, self.table["Torque Enable"], 0, answered=self._answered())
        if self.bus.read(self.found.bus_id, self.table["Torque Enable"]):
            raise RequestRejected(
                f"Servo {self.found.bus_id} does not switch its torque off.",
                next_step="Switch its supply off and on, then try again.",
            )

    def _answered(self) -> bool:
        """Return whether the servo answers a write; it may be set to answer reads only."""
        return self.bus.read(self.found.bus_id, self.table["Status Return Level"]) == 2

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
def single_servo(context: DoctorContext, progress: Callable[[str], None] = lambda _: None) -> Iterator[SingleServo]:
    """Yield the only servo on the configured port, opened exclusively; see `SingleServo`."""
    context.require_free()
    context.computer.require_unused(context.config.servo.port)
    wire = context.computer.open_serial(context.config.servo.port, context.config.servo.baud)
    try:
        yield SingleServo(context, wire, progress)
    finally:
        wire.close()


def _scanned(scan: Generator[str, None, list[BaudScan]], progress: Callable[[str], None]) -> list[BaudScan]:
    """Return what a scan returns, and report its texts."""
    while True:
        try:
            progress(next(scan))
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]


def _find_only_servo(context: DoctorContext, wire: SerialConnection, progress: Callable[[str], None]) -> FoundServo:
    """Scan all baud rates: a second servo at another rate would answer as soon as the rates are equal."""
    scans = _scanned(scan_rates(context, wire, BAUD_RATES, context.config.servo.port), progress)
    if scans and (ids := scans[-1].duplicate_ids):
        raise SeveralServos(
            f"Two servos answer at once to id {', '.join(map(str, ids))} at {scans[-1].baud} baud.",
            next_step="Unplug all other servos, then try again.",
            evidence={"ids": list(ids), "baud": scans[-1].baud},
        )
    found = [servo for scan in scans for servo in scan.servos]
    if not found:
        raise DeviceNotFound(
            f"No servo answers on {context.config.servo.port} at any baud rate.",
            next_step="Check the servo's cable and switch on its supply (its LED blinks once), then try again.",
            evidence={"port": context.config.servo.port},
        )
    if len(found) > 1:
        raise SeveralServos(
            f"There are {len(found)} servos on {context.config.servo.port}.",
            next_step="Unplug all other servos, then try again.",
            evidence={"servos": list(map(str, found))},
        )
    return found[0]
