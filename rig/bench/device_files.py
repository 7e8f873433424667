"""Records of the device files, programs, user and disk of a computer."""

import os
import pwd
from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Process:
    """A program that has a device open."""

    pid: int
    command: str

    def __str__(self) -> str:
        return f"process {self.pid} ({self.command})"


@dataclass(frozen=True, slots=True)
class DeviceFile:
    """A device file, and its properties that are known without opening it.

    ``stable`` is its name that stays the same after replugging, ``group`` its user group. ``usable`` says whether this
    user may open it. ``holders`` are the programs that have it open, as far as this user may see them.
    """

    path: str
    name: str
    stable: str | None
    group: str
    usable: bool
    holders: tuple[Process, ...]


@dataclass(frozen=True, slots=True)
class SerialPort(DeviceFile):
    """A serial port; ``latency_ms`` is the adapter's latency timer (in `latency_file`), None if it has none."""

    latency_ms: int | None
    latency_file: str
    usb: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class User:
    """The user of this program; ``gids`` are the groups of this login."""

    name: str
    uid: int
    gids: frozenset[int]

    @classmethod
    def current(cls) -> "User":
        uid = os.geteuid()
        try:
            name = pwd.getpwuid(uid).pw_name
        except KeyError:
            name = str(uid)
        return cls(name, uid, frozenset({os.getegid(), *os.getgroups()}))


@dataclass(frozen=True, slots=True)
class Disk:
    """The disk of a folder: whether it is on the network, and whether this user may write."""

    free_bytes: int
    network: bool
    writable: bool = True
