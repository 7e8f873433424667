"""A virtual machine with Debian's own kernel, on an overlay of this computer's files or of those of another one."""

import gzip
import json
import os
import platform
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from threading import Condition, Thread
from typing import Any, Final, Self

from rig.core.clock import SystemClock

KERNEL: Final = "RIG_TEST_KERNEL"
"""The variable that names the kernel: a package (.deb), or a folder with ``boot`` and ``lib/modules``.

A folder with Python, too, has all files of the machine, for example those of an arm64 computer (``guest/computer.sh``).
"""
ACCELERATOR: Final = "RIG_TEST_ACCELERATOR"
"""The variable that chooses QEMU's accelerator, for example ``kvm``; default: emulation, which works everywhere."""
PACKAGES: Final = {"busybox": "busybox-static", "modprobe": "kmod"}
"""Programs, and the Debian packages that have them."""
MODULES: Final = ("virtio_pci", "9pnet_virtio", "9p", "overlay")
"""What the kernel needs to find its files."""
BOOT_S: Final = 300.0
BOOTS: Final = 3
"""Attempts to start the kernel, whose measurement of its timer fails while other programs use the processor."""
SILENT_S: Final = 120.0
"""If the machine has printed nothing in this time, its kernel hangs."""
ANSWER_S: Final = 300.0
PROJECT: Final = Path(__file__).parents[2]
_INIT = """#!/bin/busybox sh
busybox=/bin/busybox
$busybox mkdir -p /proc /sys /dev /newroot /lower /upper
$busybox mount -t proc proc /proc
$busybox mount -t sysfs sys /sys
$busybox mount -t devtmpfs dev /dev
for module in /modules/*.ko; do $busybox insmod $module || echo "no module $module"; done
$busybox mount -t 9p -o trans=virtio,version=9p2000.L,msize=512000,cache=loose,ro host /lower
$busybox mount -t tmpfs -o size=1g,mode=0755 upper /upper
$busybox mkdir -p /upper/files /upper/work
$busybox mount -t overlay -o lowerdir=/lower,upperdir=/upper/files,workdir=/upper/work overlay /newroot
if [ ! -d /newroot{project} ]; then  # the files of another computer
    $busybox mkdir -p /newroot{project}
    $busybox mount -t 9p -o trans=virtio,version=9p2000.L,msize=512000,cache=loose,ro project /newroot{project}
fi
for folder in proc sys dev; do $busybox mount --move /$folder /newroot/$folder; done
exec $busybox switch_root /newroot /bin/bash {project}/tests/kernel/guest/init.sh
"""


@dataclass(frozen=True, slots=True)
class Architecture:
    """How QEMU emulates a computer: its program, the package of it, its options, and the kernel's own options."""

    qemu: str
    package: str
    machine: tuple[str, ...]
    line: str


X86_64: Final = Architecture(
    "qemu-system-x86_64",
    "qemu-system-x86",
    ("-machine", "q35", "-cpu", "max"),
    "console=ttyS0 mitigations=off nokaslr tsc=reliable",
)
ARM64: Final = Architecture(
    "qemu-system-aarch64",
    "qemu-system-arm",
    ("-machine", "virt", "-cpu", "cortex-a76"),  # the processor of a Raspberry Pi 5
    "console=ttyAMA0 mitigations=off nokaslr",
)


@dataclass(frozen=True, slots=True)
class Kernel:
    """A kernel: its folder, and the folder of the files that the machine sees."""

    folder: Path
    files: Path = Path("/")

    @property
    def release(self) -> str:
        return next((self.folder / "lib/modules").iterdir()).name

    @property
    def architecture(self) -> Architecture:
        return ARM64 if self.release.endswith("-arm64") else X86_64

    @property
    def python(self) -> Path:
        """Python in the machine."""
        return Path(sys.executable) if self.files == Path("/") else Path("/usr/bin/python3")


class NotReady(Exception):
    """This computer cannot run the virtual machine; the text says what is missing and how to get it."""


def find_kernel() -> Kernel:
    """Return the kernel, after unpacking its package beside it.

    Raises
    ------
    NotReady
        Something is missing.
    """
    if platform.machine() != "x86_64":
        raise NotReady(f"the kernel tests need an x86-64 computer, not {platform.machine()}")
    path = Path(os.environ.get(KERNEL, ""))
    packages = [path] if path.suffix == ".deb" else sorted(path.glob("linux-image-*.deb")) if path.name else []
    if packages and packages[-1].is_file():
        path = _unpacked(packages[-1])
    if not path.name or not list(path.glob("boot/vmlinuz-*")):
        raise NotReady(f"{KERNEL}={path} names no kernel: `make kernel-test` says how to get one")
    kernel = Kernel(path, path if (path / "usr/bin/python3").exists() else Path("/"))
    programs = {kernel.architecture.qemu: kernel.architecture.package, **PACKAGES}
    if kernel.files == Path("/"):  # else the folder has its own
        programs["udevadm"] = "udev"
    if missing := [package for program, package in programs.items() if _found(program) is None]:
        raise NotReady(f"packages are missing: sudo apt-get install --no-install-recommends {' '.join(missing)}")
    return kernel


def _found(program: str) -> str | None:
    return shutil.which(program, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin")


def _unpacked(package: Path) -> Path:
    """Unpack a kernel's package beside it, once."""
    folder = package.with_suffix("")
    if not (folder / "complete").exists():
        shutil.rmtree(folder, ignore_errors=True)
        subprocess.run(["dpkg-deb", "-x", package, folder], check=True)
        release = next((folder / "lib/modules").iterdir()).name
        subprocess.run([_found("depmod") or "depmod", "-b", folder, release], check=True)
        (folder / "complete").touch()
    return folder


def initial_files(kernel: Kernel) -> bytes:
    """Return the kernel's initial file system: busybox, the modules that find the files, and what starts them."""
    files: list[tuple[str, int, bytes]] = [(name, 0o40755, b"") for name in ("bin", "modules")]
    files.append(("init", 0o100755, _INIT.format(project=PROJECT).encode()))
    busybox = Path(_found("busybox") or "") if kernel.files == Path("/") else kernel.files / "usr/bin/busybox"
    files.append(("bin/busybox", 0o100755, busybox.read_bytes()))
    modules: list[str] = []
    for module in MODULES:
        command = [_found("modprobe") or "modprobe", "-d", str(kernel.folder), "-S", kernel.release]
        command += ["--show-depends", module]
        listed = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
        modules += [line.split()[1] for line in listed if line.startswith("insmod")]
    for number, path in enumerate(dict.fromkeys(modules)):
        files.append((f"modules/{number:02d}.ko", 0o100644, Path(path).read_bytes()))
    return gzip.compress(b"".join(_cpio(files)), 1)


def _cpio(files: list[tuple[str, int, bytes]]) -> Iterator[bytes]:
    """Yield an archive in cpio's format "newc" (Documentation/driver-api/early-userspace/buffer-format.rst)."""
    for number, (name, mode, data) in enumerate([*files, ("TRAILER!!!", 0, b"")], 1):
        path = name.encode() + b"\0"
        fields = (number, mode, 0, 0, 1, 0, len(data), 0, 0, 0, 0, len(path), 0)
        head = b"070701" + b"".join(b"%08X" % field for field in fields) + path
        yield head + bytes(-len(head) % 4) + data + bytes(-len(data) % 4)


@dataclass(frozen=True, slots=True)
class Result:
    """The result of a program in the machine: its exit code, its whole output, and its standard output."""

    code: int
    output: str
    result: str


class Machine:
    """A running virtual machine, whose agent carries out requests."""

    def __init__(self, kernel: Kernel, folder: Path) -> None:
        self.kernel = kernel
        architecture, release = kernel.architecture, kernel.release
        image = folder / "initrd.gz"
        image.write_bytes(initial_files(kernel))
        self.log = folder / "console.log"
        self._numbers = count(1)
        self._answers: dict[int, dict[str, Any]] = {}
        self._changed = Condition()
        with socket.create_server(("127.0.0.1", 0)) as listener:
            words = {
                "modules": kernel.folder / "lib/modules" / release,
                "python": kernel.python,
                "project": PROJECT,
                "port": listener.getsockname()[1],
            }
            line = f"{architecture.line} quiet panic=-1 net.ifnames=0"
            line += "".join(f" rig.{name}={value}" for name, value in words.items())
            command = [
                architecture.qemu,
                *architecture.machine,
                *_QEMU,
                *_shared("host", kernel.files),
                *_shared("project", PROJECT),
                *("-kernel", kernel.folder / f"boot/vmlinuz-{release}", "-initrd", image, "-append", line),
                *("-serial", f"file:{self.log}"),
            ]
            listener.settimeout(1.0)
            for attempt in range(1, BOOTS + 1):
                with (folder / "qemu.log").open("wb") as output:
                    self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=output)
                if (connection := self._agent(listener, last=attempt == BOOTS)) is not None:
                    break
            assert connection is not None
            self._connection = connection
        self._reader = Thread(target=self._read, daemon=True)
        self._reader.start()

    def _agent(self, listener: socket.socket, *, last: bool) -> socket.socket | None:
        """Wait until the machine runs; None if its kernel has stopped or hangs, and this was not the last try."""
        clock = SystemClock()
        begun_ns = clock.now_ns()
        while self._process.poll() is None and clock.now_ns() - begun_ns < BOOT_S * 1e9:
            with suppress(TimeoutError):
                connection = listener.accept()[0]
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                connection.settimeout(None)
                return connection
            if not last and clock.now_ns() - begun_ns > SILENT_S * 1e9 and not self._printed:
                break
        if not last and (self._process.poll() is not None or not self._printed):
            self._process.kill()
            self._process.wait()
            return None
        self._process.kill()
        self._process.wait()
        raise RuntimeError(f"the virtual machine did not start:\n{self._printed[-4000:]}")

    @property
    def _printed(self) -> str:
        return self.log.read_text(errors="replace") if self.log.exists() else ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        with suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)
        self._reader.join()
        self._connection.close()

    def ask(self, what: str, *, answer_s: float = ANSWER_S, **values: Any) -> Any:
        """Return the agent's answer to a request."""
        number = next(self._numbers)
        line = json.dumps({"number": number, "do": what, **values}).encode() + b"\n"
        self._connection.sendall(line)
        with self._changed:
            if not self._changed.wait_for(lambda: number in self._answers, answer_s):
                raise TimeoutError(f"{what} {values}: no answer in {answer_s:g} s")
            answer = self._answers.pop(number)
        if "error" in answer:
            raise RuntimeError(f"{what} {values}: {answer['error']}")
        return answer["value"]

    def _read(self) -> None:
        with suppress(OSError), self._connection.makefile("r", encoding="utf-8") as lines:
            for line in lines:
                answer = json.loads(line)
                with self._changed:
                    self._answers[answer.get("number", 0)] = answer
                    self._changed.notify_all()


class GuestProcess:
    """A program that runs in the machine."""

    def __init__(self, machine: Machine, pid: int) -> None:
        self.pid = pid
        self._machine = machine

    @property
    def output(self) -> str:
        """The output of the program so far."""
        return str(self._machine.ask("output", pid=self.pid))

    @property
    def runs(self) -> bool:
        return bool(self._machine.ask("runs", pid=self.pid))

    def signal(self, number: int) -> None:
        self._machine.ask("signal", pid=self.pid, signal_number=number)

    def wait(self, timeout: float = ANSWER_S) -> Result:
        """Return the result of the program; raises TimeoutError."""
        ended = self._machine.ask("wait", answer_s=timeout + 10, pid=self.pid, timeout=timeout)
        if ended is None:
            raise TimeoutError(f"the program has not ended in {timeout:g} s:\n{self.output}")
        return Result(**ended)


_QEMU: Final[list[str | Path]] = [
    *("-smp", "2", "-m", "3G"),
    *("-accel", os.environ.get(ACCELERATOR, "tcg,thread=multi")),
    *("-nodefaults", "-display", "none", "-no-reboot"),
    *("-netdev", "user,id=net", "-device", "virtio-net-pci,netdev=net"),
]


def _shared(name: str, folder: Path) -> list[str]:
    """Return the options that show a folder to the machine, which cannot write to it."""
    files = f"local,id={name},path={folder},security_model=none,readonly=on,multidevs=remap"
    return ["-fsdev", files, "-device", f"virtio-9p-pci,fsdev={name},mount_tag={name}"]
