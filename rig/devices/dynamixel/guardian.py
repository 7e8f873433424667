"""A small process that switches the torque off if the program dies before it has done so, for example by `kill -9`.

The program holds one end of a pipe. When the program dies, the system closes that end, and the guardian opens the
servo's port. It has its own session, so Ctrl+C at the terminal does not end it. A simulated servo in the memory of
the program dies with it and needs no guardian. With `-P`, Python imports nothing from the working directory.
"""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from typing import Final

from rig.core.clock import SystemClock, seconds_between
from rig.core.errors import RigError
from rig.devices.dynamixel.bus import DynamixelBus
from rig.devices.dynamixel.port import GUARDIAN, GUARDIAN_S, ClockedPort, open_serial
from rig.devices.dynamixel.registers import control_table

_RETRY_S: Final = 0.05  # longer: the torque stays on longer; shorter: the waiting takes a whole core
_ON, _OFF = b"1", b"0"


class Guardian:
    """Guards the torque of the servo ``bus_id`` at the serial port ``port``; starts its process at the first `arm`."""

    def __init__(self, port: str, baud: int, model: str, bus_id: int) -> None:
        self._arguments = [port, str(baud), model, str(bus_id)]
        self._process: subprocess.Popen[bytes] | None = None

    def arm(self) -> None:
        """Let the guardian switch the torque off if this program dies; call it before switching the torque on."""
        if self._process is None or self._process.poll() is not None:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", GUARDIAN, *self._arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
                bufsize=0,
            )
        self._tell(_ON)

    def disarm(self) -> None:
        """Report to the guardian that the torque is off."""
        self._tell(_OFF)

    def close(self) -> None:
        """End the process. If it is still armed, it switches the torque off first: the port must be closed by then."""
        process, self._process = self._process, None
        if process is not None and process.stdin is not None:
            process.stdin.close()
            with suppress(subprocess.TimeoutExpired):
                process.wait(GUARDIAN_S)

    def _tell(self, word: bytes) -> None:
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):  # the process was ended: the servo's watchdog remains
                self._process.stdin.write(word)


def watch(port: str, baud: int, model: str, bus_id: int) -> bool:
    """Wait until standard input ends; then return whether the torque is off."""
    armed = False
    while words := os.read(0, 64):
        armed = words.endswith(_ON)
    if not armed:
        return True
    clock = SystemClock()
    begun_ns = clock.now_ns()
    while seconds_between(begun_ns, clock.now_ns()) < GUARDIAN_S:
        with suppress(RigError):
            connection = open_serial(port, baud)
            try:
                bus = DynamixelBus(ClockedPort(connection, clock, port))
                torque = control_table(model)["Torque Enable"]
                bus.write(bus_id, torque, 0)
                if not bus.read(bus_id, torque):
                    return True
            finally:
                connection.close()
        clock.sleep(_RETRY_S)
    return False


if __name__ == "__main__":
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, signal.SIG_IGN)
    sys.exit(not watch(sys.argv[1], int(sys.argv[2]), sys.argv[3], int(sys.argv[4])))
