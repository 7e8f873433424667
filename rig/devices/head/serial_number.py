"""Reads the identity of a rig head, and stores its serial number by the head's own protocol."""

from rig.core.clock import Clock
from rig.core.errors import DeviceFault
from rig.devices.dynamixel.port import SerialConnection
from rig.devices.head.connection import HeadConnection
from rig.devices.head.protocol import DEADMAN_MAX_MS, Done, Identity, SetSerial


def read_identity(connection: SerialConnection, clock: Clock, *, name: str) -> Identity:
    """Return the identity of the head at an open port. Raises as `store_serial`."""
    return _greeted(connection, clock, name).identity


def store_serial(connection: SerialConnection, clock: Clock, serial: int, *, name: str) -> Identity:
    """Store a serial number in the head, read it back, and return the new identity.

    Parameters
    ----------
    connection
        The head's open port.
    serial
        The number, 0 to 2³² − 2.
    name
        Name of the port in messages.

    Raises
    ------
    DeviceNotFound, FirmwareMismatch, DeviceSilent
        No head answers, or one with another protocol.
    RequestRejected
        A program uses the head, or its firmware is older than 1.1.
    DeviceFault
        The head reports another number afterwards.
    """
    head = _greeted(connection, clock, name)
    head.link.request(SetSerial(serial), Done)
    head.identify()
    if head.identity.serial != serial:
        raise DeviceFault(
            f"The rig head at {name} did not store its serial number.",
            next_step="Try again. If this repeats, its EEPROM is worn out: use another board.",
            evidence={"requested": serial, "reported": head.identity.serial},
        )
    return head.identity


def _greeted(connection: SerialConnection, clock: Clock, name: str) -> HeadConnection:
    head = HeadConnection(connection, clock, lambda _: None, deadman_ms=DEADMAN_MAX_MS, name=name, reopen=None)
    head.greet()
    return head
