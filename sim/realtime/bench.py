"""The bench ``sim-bench``: the drivers of a real bench, connected to a simulated bench that another program runs."""

import os
from collections.abc import Iterator
from contextlib import closing, contextmanager
from errno import EIO
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field

from rig.bench import BenchKind
from rig.bench.computer import Computer
from rig.bench.hardware import HardwareBench
from rig.config import RigConfig, Section
from rig.core.errors import ConfigError, DeviceNotFound
from rig.core.next_steps import Do
from rig.devices.camera import Capture
from rig.devices.dynamixel.port import SerialConnection
from rig.safety.saved_state import holder
from sim.camera import CAMERA_DEVICE, SELECT_S
from sim.i2c import KernelBus, Messages
from sim.realtime.wire import COMPUTER, CONFIG, DEFAULT_FOLDER, SERVO, STATE, Wire, not_running


class RemoteCapture(Capture):
    """The simulated bench's camera; behaves like `cv2.VideoCapture`.

    Raises `DeviceNotFound`: the simulated bench is not running, its camera is unplugged, or another program uses it.
    """

    def __init__(self, folder: Path) -> None:
        self._wire = Wire(folder)
        if (answer := self._ask("open")) != "open":
            self.release()
            step = "Close the program that uses it." if answer == "busy" else "Connect the camera."
            raise DeviceNotFound("Cannot open the simulated camera.", next_step=step)

    def isOpened(self) -> bool:  # noqa: N802
        return bool(self._ask("isOpened"))

    def wait(self, seconds: float) -> bool:
        """Wait for a frame for at most this time; return whether `grab` then returns at once."""
        return self._ask("wait", seconds) is not False  # None: the simulated bench has ended, so `grab` fails

    def grab(self) -> bool:
        return self.wait(SELECT_S) and bool(self._ask("grab"))

    def retrieve(self) -> tuple[bool, Any]:
        shape = self._ask("retrieve")
        if shape is None:
            return False, None
        return True, np.frombuffer(bytearray(self._pixels), dtype=np.uint8).reshape(shape)

    def get(self, propId: int, /) -> float:
        return float(self._ask("get", propId) or 0.0)

    def set(self, propId: int, value: float, /) -> bool:
        return bool(self._ask("set", propId, value))

    def release(self) -> None:
        self._ask("release")  # when it has returned, another program can open the camera
        self._wire.close()

    def _ask(self, call: str, *given: float) -> Any:
        """Return the value of a call; None if the simulated bench has ended, or the camera is closed."""
        try:
            answer, self._pixels = self._wire.ask(ask="camera", call=call, given=given)
        except (OSError, ValueError):
            return None
        return answer["value"]


def camera_node(folder: Path) -> tuple[int, ...] | None:
    """Return the identity of the device file of the simulated bench's camera; None if it is unplugged."""
    try:
        with closing(Wire(folder)) as wire:
            node = wire.ask(ask="camera", call="node", given=[])[0]["value"]
    except (DeviceNotFound, OSError, ValueError):
        return None
    return node and tuple(node)


class RemoteI2c(KernelBus):
    """The simulated bench's I2C bus. Opens its connection at the first transfer."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder
        self._wire: Wire | None = None

    def close(self) -> None:
        super().close()
        if self._wire is not None:
            self._wire.close()

    def transfer(self, messages: Messages) -> list[bytes]:
        given = [[address, one if isinstance(one, int) else one.hex()] for address, one in messages]
        try:
            self._wire = self._wire or Wire(self._folder)
            answer, received = self._wire.ask(ask="i2c", messages=given)
        except (DeviceNotFound, OSError, ValueError) as error:
            raise OSError(EIO, os.strerror(EIO)) from error
        if answer["errno"]:
            raise OSError(answer["errno"], os.strerror(answer["errno"]))
        ends = list(accumulate(one for _, one in messages if isinstance(one, int)))
        return [received[start:end] for start, end in zip([0, *ends], ends, strict=False)]


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
