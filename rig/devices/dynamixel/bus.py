"""Registers by name on a Dynamixel bus, through the unmodified SDK."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from threading import RLock
from typing import Any

import serial
from dynamixel_sdk import COMM_RX_CORRUPT, COMM_SUCCESS, Protocol2PacketHandler

from rig.devices.dynamixel.port import ClockedPort, LineBabble
from rig.devices.dynamixel.registers import Register
from rig.errors import DeviceRefused, DeviceSilent

_ALERT = 0x80
_STATUS_ERRORS = {
    1: "result fail",
    2: "instruction error",
    3: "CRC error",
    4: "data range error",
    5: "data length error",
    6: "data limit error",
    7: "access error",
}


@dataclass(slots=True)
class BusStatistics:
    """What the line was like since it was opened."""

    transactions: int = 0
    retries: int = 0
    timeouts: int = 0
    corrupt: int = 0


class DynamixelBus:
    """Reads and writes registers; retries what the line spoiled, and never takes a failed read for a value.

    Parameters
    ----------
    port
        An open port.
    retries
        How often a transaction is repeated before the device counts as silent. All instructions used here are absolute
        (a read, or a write of a value), so that repeating one does no harm.
    """

    def __init__(self, port: ClockedPort, retries: int = 3) -> None:
        self.port = port
        self.statistics = BusStatistics()
        self._packets = Protocol2PacketHandler()
        self._retries = retries
        self._lock = RLock()
        self._alerts: set[int] = set()
        self._unanswered = False  # the last question, even when Ctrl+C cut it short: its answer may still be coming

    def alert(self, device_id: int) -> bool:
        """Return whether the device's last status packet carried the alert bit (its Hardware Error Status is not 0)."""
        return device_id in self._alerts

    def ping(self, device_id: int) -> int:
        """Return the model number of the device."""
        return int(self._transact("ping", device_id, 0, lambda: self._packets.ping(self.port, device_id)))

    def read(self, device_id: int, register: Register) -> int:
        return register.decode(self.read_block(device_id, register.address, register.size))

    def read_block(self, device_id: int, address: int, size: int) -> bytes:
        """Return ``size`` bytes from ``address``, all of one moment."""
        data = self._transact(
            f"read of {size} bytes at {address}",
            device_id,
            size,
            lambda: self._packets.readTxRx(self.port, device_id, address, size),
        )
        return bytes(data)

    def write(self, device_id: int, register: Register, value: int) -> None:
        data = list(register.encode(value))
        self._transact(
            f"write of {register.name} = {value}",
            device_id,
            0,
            lambda: (None, *self._packets.writeTxRx(self.port, device_id, register.address, register.size, data)),
        )

    def reboot(self, device_id: int) -> None:
        self._transact("reboot", device_id, 0, lambda: (None, *self._packets.reboot(self.port, device_id)))

    def close(self) -> None:
        self.port.closePort()

    def _transact(self, what: str, device_id: int, size: int, call: Callable[[], tuple[Any, int, int]]) -> Any:
        """Run an SDK call (payload, result, error) until it succeeds or the retries are used up; return the payload."""
        with self._lock:
            for attempt in range(self._retries + 1):
                self.statistics.transactions += 1
                self.statistics.retries += attempt > 0
                try:
                    if self._unanswered:
                        self.port.drain()
                    self._unanswered = True
                    payload, result, error = call()
                except (serial.SerialException, OSError) as unplugged:
                    raise self._silent(what, device_id, f"the port failed: {unplugged}") from unplugged
                except (LineBabble, IndexError):
                    # The SDK indexes into status packets that are shorter than it expects.
                    payload, result, error = None, COMM_RX_CORRUPT, 0
                finally:
                    self.port.is_using = False
                if result == COMM_SUCCESS and (error & ~_ALERT or size == 0 or len(payload) == size):
                    self._unanswered = False
                    self._note_alert(device_id, error)
                    if error & ~_ALERT:
                        raise self._refused(what, device_id, error & ~_ALERT)
                    return payload
                if result == COMM_SUCCESS:
                    result = COMM_RX_CORRUPT
                self._count(result)
            raise self._silent(what, device_id, self._packets.getTxRxResult(result).removeprefix("[TxRxResult] "))

    def _note_alert(self, device_id: int, error: int) -> None:
        if error & _ALERT:
            self._alerts.add(device_id)
        else:
            self._alerts.discard(device_id)

    def _count(self, result: int) -> None:
        if result == COMM_RX_CORRUPT:
            self.statistics.corrupt += 1
        else:
            self.statistics.timeouts += 1

    def _silent(self, what: str, device_id: int, reason: str) -> DeviceSilent:
        return DeviceSilent(
            f"Servo {device_id} does not answer ({what}).",
            next_step="Check the servo's cable and its supply (its LED blinks at power-up), then start again.",
            evidence={"reason": reason, "attempts": self._retries + 1, "baud": self.port.baudrate},
        )

    def _refused(self, what: str, device_id: int, error: int) -> DeviceRefused:
        return DeviceRefused(
            f"Servo {device_id} refused the {what}: {_STATUS_ERRORS.get(error, f'error {error}')}.",
            next_step="Run `rig status` to see the servo's state; a tripped watchdog or hardware error forbids motion.",
            evidence={"status_error": error, "alert": self.alert(device_id)},
        )


def watchdog_units(timeout_s: float) -> int:
    """Return the Bus Watchdog's register value for a timeout: units of 20 ms, rounded up, within 1..127."""
    return min(max(math.ceil(timeout_s / 0.02), 1), 127)
