"""Runs a simulated bench in real time."""

import os
import signal
import sys
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path

from rig.cli.ui.settings import Settings
from rig.config import ServoConfig
from rig.core.errors import UsageError, os_errors_as
from rig.devices.dynamixel.port import SerialConnection
from rig.safety.saved_state import FileStore
from sim.bench import ShelfOperator, new_world, rest_angle_deg
from sim.computer import configure_servo, write_files
from sim.devices import SimDevices
from sim.faults import Faults
from sim.faults.injector import Occurrence
from sim.faults.schedule import read_faults
from sim.objects.shelf import shelf
from sim.realtime import folder as folders
from sim.realtime.bench import RunningSimBench
from sim.realtime.commands import Commands, run
from sim.realtime.pace import RealTime
from sim.realtime.port import PtyPort
from sim.realtime.server import BenchServer
from sim.realtime.wire import COMPUTER, HEAD, SERVO
from sim.servo.base import BOOT_S


def run_bench(settings: Settings, folder: Path | None, seconds: float | None) -> None:
    """Run a bench in a folder until it is ended.

    Raises `BenchBusy`, `UsageError`, `ConfigError`: see `sim.realtime.folder`.
    """
    with ExitStack() as ends:
        # The world, as `rig.bench` finds it: the servo is configured, and the table is where it was left.
        folder = folders.reserve(folder, ends)
        config, options = folders.configure(folder, settings)
        world = new_world(
            options, settings.seed, rest_angle_deg(config, FileStore(config.state_path(RunningSimBench.name)))
        )
        devices = ends.enter_context(SimDevices.connected(config, world))
        _set_up(devices, config.servo)
        write_files(folder / COMPUTER, config)
        faults = Faults(devices)
        ends.callback(faults.clear)
        faults.listeners.append(lambda occurrence: _print_fault(settings, occurrence))
        faults.schedule(*read_faults(options.faults))

        # The interfaces for other programs and for the trainee.
        ports = [_port(devices.reopen_adapter, folder / SERVO, ends)]
        if devices.head is not None:
            ports.append(_port(devices.head_port, folder / HEAD, ends))
        time = RealTime(world.clock, ports)
        operator = ShelfOperator(world, shelf())
        commands = Commands(operator, devices, faults, quit=lambda: setattr(time, "over", True))
        server = ends.enter_context(BenchServer(folder, devices, time, commands))
        inputs: dict[int, Callable[[], bool]] = {server.fileno(): server.accept}
        if (keyboard := _Keyboard(settings, time, commands)).usable():
            inputs[sys.stdin.fileno()] = keyboard.read

        text = (
            f"The simulated bench is running in {folder}. Stop it with Ctrl+C.\n"
            f"In a second terminal: cd {folder}; then for example: rig status\n"
            "Type what happens at the bench, for example: put mug-white. For a list: help"
        )
        settings.say(text, {"folder": str(folder), "servo": ports[0].path, "head": config.imu.connection == "head"})
        with suppress(KeyboardInterrupt):  # Ctrl+C is the usual end
            time.run(seconds, inputs)
    settings.say("The simulated bench has ended.", {"ended": True})


class _Keyboard:
    """Commands of the trainee from standard input."""

    def __init__(self, settings: Settings, time: RealTime, commands: Commands) -> None:
        self._settings, self._time, self._commands = settings, time, commands
        self._text = b""

    def usable(self) -> bool:
        """Return whether there is a standard input; a program in the background gets an error instead of a stop."""
        with suppress(OSError, ValueError, AttributeError):  # closed, or this is not the main thread
            signal.signal(signal.SIGTTIN, signal.SIG_IGN)
            os.fstat(sys.stdin.fileno())
            return True
        return False

    def read(self) -> bool:
        """Carry out the typed command; return False at the end of the input."""
        try:
            typed = os.read(sys.stdin.fileno(), 4096)
        except OSError:  # in the background
            return False
        *lines, self._text = (self._text + typed).split(b"\n")
        for line in lines:
            if words := line.decode(errors="replace").split():
                with self._time.present():
                    answer = run(self._commands, words)
                failed = answer.get("failed")
                self._settings.say(f"{failed['what']} {failed['next_step']}" if failed else answer["text"], answer)
        return bool(typed)


def _port(open_connection: Callable[[], SerialConnection], link: Path | None, ends: ExitStack) -> PtyPort:
    with os_errors_as(UsageError, f"Cannot create {link}.", next_step="Give a name that is not in use."):
        port = PtyPort(open_connection, link)
    ends.callback(port.close)
    return port


def _set_up(devices: SimDevices, config: ServoConfig) -> None:
    """Write the servo's permanent settings, even if its supply is off."""
    was_on = devices.servo.powered
    devices.servo.power_on()
    devices.world.clock.sleep(BOOT_S)
    configure_servo(devices, config)
    if not was_on:
        devices.servo.power_off()


def _print_fault(settings: Settings, occurrence: Occurrence) -> None:
    name, word = occurrence.fault.kind.name, "begins" if occurrence.began else "ends"
    settings.say(f"Fault {word}: {name}", {"fault": name, "began": occurrence.began})
