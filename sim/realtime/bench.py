"""The bench ``sim-bench``: the drivers of a real bench, connected to a simulated bench that another program runs."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field

from rig.bench import BenchKind
from rig.bench.computer import Computer
from rig.bench.hardware import HardwareBench
from rig.config import RigConfig, Section
from rig.core.errors import ConfigError, DeviceNotFound
from rig.core.next_steps import Do
from rig.devices.dynamixel.port import SerialConnection
from rig.devices.opencv_capture import Capture
from rig.safety.saved_state import holder
from sim.camera import CAMERA_DEVICE
from sim.realtime.client import RemoteCapture, RemoteI2c, camera_node
from sim.realtime.wire import COMPUTER, CONFIG, DEFAULT_FOLDER, SERVO, STATE, not_running


class SimBenchOptions(Section):
    """The section ``[bench.sim-bench]``."""

    folder: Path = Field(DEFAULT_FOLDER, description="folder of the simulated bench that `rig sim-bench` runs")


class SimBenchComputer(Computer):
    """The computer to which the devices of a running simulated bench are connected."""

    def __init__(self, folder: Path, config: RigConfig) -> None:
        super().__init__(folder / COMPUTER)
        self._folder = folder
        self._config = config
        self._i2c: RemoteI2c | None = None

    def open_serial(self, path: str, baud: int, device: str = "servo") -> SerialConnection:
        for port in (self._config.servo.port, self._config.head.port):
            if self.same_file(path, port):
                return super().open_serial(port, baud, device)
        raise DeviceNotFound(f"No port {path}.", next_step="Connect the adapter.", evidence={"port": path})

    def i2c_path(self, bus: int | str) -> str:
        imu = self._config.imu
        if imu.connection != "i2c" or self.i2c_name(bus) != self.i2c_name(imu.bus):
            return super().i2c_path(bus)
        self._i2c = self._i2c or RemoteI2c(self._folder)
        return self._i2c.path

    def open_capture(self, source: int | str) -> Capture:  # noqa: ARG002 - there is one camera
        return RemoteCapture(self._folder)

    def device_node(self, source: int | str) -> tuple[int, ...] | None:  # noqa: ARG002
        return camera_node(self._folder)

    def camera_device(self, source: int | str) -> str | None:  # noqa: ARG002
        return CAMERA_DEVICE

    def close(self) -> None:
        """Remove its I2C bus."""
        if self._i2c is not None:
            self._i2c.close()


class RunningSimBench(HardwareBench):
    """The kind of bench ``sim-bench``: opens the devices of a running simulated bench as those of a real one."""

    name = "sim-bench"
    options: type[BaseModel] = SimBenchOptions

    @contextmanager
    def computer(self, config: RigConfig, options: Any, seed: int | None) -> Iterator[Computer]:  # noqa: ARG002
        """Yield the computer of the simulated bench.

        Raises `DeviceNotFound`: the bench is not running. `ConfigError`: the configuration is not the one in the
        bench's folder. It could name the port of a real servo.
        """
        assert isinstance(options, SimBenchOptions)
        folder = options.folder.absolute()
        if holder(folder) is None:
            raise not_running(folder)
        if (config.servo.port, config.state_dir) != (str(folder / SERVO), folder / STATE):
            raise ConfigError(
                f"This configuration does not belong to the simulated bench in {folder}.",
                next_step=("Run the command in that folder, or", Do.RUN_AGAIN(config=str(folder / CONFIG))),
                evidence={"servo.port": config.servo.port, "state_dir": config.state_dir},
            )
        computer = SimBenchComputer(folder, config)
        try:
            yield computer
        finally:
            computer.close()


SIM_BENCH: BenchKind = RunningSimBench()
