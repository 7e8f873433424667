"""A serial port for other programs: a pseudo-terminal in front of a simulated connection."""

import os
import tty
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from rig.core.errors import DeviceNotFound
from rig.devices.dynamixel.port import SerialConnection

_READ_BYTES = 4096  # the size of a pseudo-terminal's buffer


class PtyPort:
    """A pseudo-terminal that exists while the simulated device is plugged in.

    A pseudo-terminal has no baud rate: a program may ask for any, the connection keeps its own.

    ``open_connection`` raises DeviceNotFound while the device is unplugged. ``link`` is a name of the port that stays
    the same after it was unplugged.

    ``path`` is the pseudo-terminal's device file, empty while it does not exist; ``sent`` is the number of bytes that
    other programs were sent.

    Raises `DeviceNotFound`: the device is unplugged. `OSError`: the link cannot be created.
    """

    def __init__(self, open_connection: Callable[[], SerialConnection], link: Path | None = None) -> None:
        self.path = ""
        self.sent = 0
        self._open_connection = open_connection
        self._link = link
        self._connection: SerialConnection | None = None
        self._far = self._near = -1
        self._plug_in()

    def fileno(self) -> int:
        """Return the file descriptor that becomes readable when a program writes; -1 while unplugged."""
        return self._far

    @property
    def near(self) -> int:
        """The end that programs open, as a file descriptor; it has the settings that a program has made."""
        return self._near

    def pump(self) -> bool:
        """Transfer the waiting bytes in both directions; return whether there were any."""
        moved = False
        try:
            connection = self._connection or self._plug_in()
            with suppress(BlockingIOError):
                connection.write(os.read(self._far, _READ_BYTES))
                moved = True
            if waiting := connection.in_waiting:
                data = connection.read(waiting)
                moved = True
                with suppress(BlockingIOError):  # no program reads: the bytes are lost
                    self.sent += os.write(self._far, data)
        except DeviceNotFound:  # still unplugged
            pass
        except OSError:  # unplugged; pyserial's errors are OSErrors, too
            self.close()
        return moved

    def close(self) -> None:
        """Remove the port, as when it is unplugged: programs that have it open get errors."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        if self._link is not None and self._link.is_symlink() and str(self._link.readlink()) == self.path:
            self._link.unlink()
        for descriptor in (self._far, self._near):
            if descriptor >= 0:
                os.close(descriptor)
        self._far = self._near = -1
        self.path = ""

    def _plug_in(self) -> SerialConnection:
        connection = self._connection = self._open_connection()
        # The near end stays open here, because reading the far end fails if no program has the near end open.
        self._far, self._near = os.openpty()
        tty.setraw(self._near)
        os.set_blocking(self._far, False)
        self.path = os.ttyname(self._near)
        if self._link is not None:
            self._link.symlink_to(self.path)
        return connection
