"""Simulated computers with a bench's devices, for the tests of checks and scans."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory

from rig.bench.computer import User
from rig.config import load_config
from rig.core.next_steps import NextSteps
from rig.doctor.checks import CHECKS
from rig.doctor.examination import DoctorContext, run_checks
from rig.doctor.finding import Finding, Severity
from sim.clock import VirtualClock
from sim.computer import ComputerFiles, SimComputer
from sim.devices import SimDevices
from sim.noise import NoiseModel
from sim.servo import Sender, SentBytes, SimServo
from sim.world import World


@dataclass
class Bench:
    """A bench that is not open: the files of its computer, its devices, and the traffic on the servo's bus."""

    computer: ComputerFiles
    devices: SimDevices
    context: DoctorContext
    sent: list[SentBytes] = field(default_factory=list)

    def add_servo(self, bus_id: int, baud: int, model: str = "xl430_w250") -> SimServo:
        """Connect another servo to the bus."""
        servo = SimServo(World(clock=self.devices.world.clock), model, bus_id=bus_id, baudrate=baud)
        self.devices.servo_bus.attach(servo)
        return servo

    def findings(self, *topics: str) -> list[Finding]:
        """Check the bench, or some topics of it."""
        return list(run_checks(self.context, [check for check in CHECKS if not topics or check.topic in topics]))

    def problems(self, *topics: str) -> dict[str, NextSteps]:
        """Return the warnings and bad findings: the code of each, and what fixes it."""
        return {f.code: f.steps for f in self.findings(*topics) if f.level is not Severity.FINE}

    def problem(self, topic: str) -> Finding:
        """Return the only warning or bad finding of a topic."""
        (found,) = (f for f in self.findings(topic) if f.level is not Severity.FINE)
        return found

    @property
    def instructions(self) -> set[int]:
        """The instructions that the host has sent (Protocol 2.0)."""
        return {frame.data[7] for frame in self.sent if frame.source is Sender.HOST and len(frame.data) > 7}


@contextmanager
def unopened(
    *settings: str,
    noise: NoiseModel | None = None,
    user: User | None = None,
    plugged: bool = True,
    servo_at: tuple[int, int] | None = None,
) -> Iterator[Bench]:
    """Yield a bench with factory settings, on its own computer.

    Parameters
    ----------
    settings
        Of the configuration, as ``KEY=VALUE``.
    plugged
        Create the device files.
    servo_at
        Id and baud rate of the servo, if they are not the configured ones.
    """
    with TemporaryDirectory() as folder:
        home = Path(folder, "home")
        paths = [f"{key}={home / key}" for key in ("catalog.path", "state_dir", "calibration_dir")]
        config = load_config(None, [*paths, *settings])
        built = config
        if servo_at is not None:
            there = config.servo.model_copy(update={"id": servo_at[0], "baud": servo_at[1]})
            built = config.model_copy(update={"servo": there})
        world = World(noise=noise, clock=VirtualClock(start_utc=datetime(2026, 5, 1, tzinfo=UTC)))
        with SimDevices.connected(built, world) as devices:
            computer = ComputerFiles(Path(folder))
            if plugged:
                computer.serial_port()
                computer.i2c_bus()
                computer.camera()
                computer.keeps_time()
            context = DoctorContext(SimComputer(Path(folder), devices, config, user), config, "sim", ("--bench", "sim"))
            bench = Bench(computer, devices, context)
            devices.servo_bus.taps.append(bench.sent.append)
            yield bench
