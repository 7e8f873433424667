"""Time of reading a servo's status by the rig's driver, compared with the SDK's read of the same registers.

The port is in memory, so that a transaction needs only processor time: with the simulated servo, and with answers
that are repeated from memory, which measures only driver and SDK. Run: python -m benchmarks.bench_servo
"""

import time
from collections.abc import Callable

from dynamixel_sdk import COMM_SUCCESS, Protocol2PacketHandler

from rig.config import ServoConfig
from rig.devices.dynamixel.port import READ_SLICE_S, ClockedPort
from rig.devices.dynamixel.registers import control_table
from rig.devices.dynamixel.servo import DynamixelServo, open_servo
from sim.noise import NoiseModel
from sim.servo import Sender, SentBytes, ServoBus, SimSerial, XSeriesServo
from sim.world import World

BAUD = 1_000_000
READS, ROUNDS, LOOP_HZ = 50, 60, 50
LIMIT = 1.5

TABLE = control_table("xl430_w250")
FIRST, SIZE = TABLE["Moving"].address, TABLE["Present Temperature"].address + 1 - TABLE["Moving"].address


class RepeatingSerial(SimSerial):
    """A simulated port that repeats recorded answers after `record`."""

    def record(self, answers: dict[bytes, bytes]) -> None:
        """Answer each of these requests from memory from now on."""
        self._answers, self._left = answers, b""
        self.read, self.write = self._play, self._again  # type: ignore[method-assign]
        self.reset_input_buffer = lambda: None  # type: ignore[method-assign]

    def _again(self, data: bytes, /) -> int:
        self._left = self._answers[data]
        return len(data)

    def _play(self, size: int = 1) -> bytes:
        data, self._left = self._left[:size], self._left[size:]
        return data


def best_us(calls: list[Callable[[], object]]) -> list[float]:
    """Return the processor time of each call in µs: the minimum of many alternating rounds."""
    best = [float("inf")] * len(calls)
    for _ in range(ROUNDS):
        for i, call in enumerate(calls):
            start_ns = time.process_time_ns()
            for _ in range(READS):
                call()
            best[i] = min(best[i], (time.process_time_ns() - start_ns) * 1e-3 / READS)
    return best


def opened() -> tuple[DynamixelServo, RepeatingSerial, ServoBus]:
    """Return a driver of a simulated servo, its port, and the bus between them."""
    world = World(noise=NoiseModel.none())
    bus = ServoBus(world.clock)
    bus.attach(XSeriesServo(world, baudrate=BAUD))
    port = RepeatingSerial(bus, BAUD, READ_SLICE_S)
    servo = open_servo(port, ServoConfig(baud=BAUD), world.clock)
    servo.prepare(write=True)
    return servo, port, bus


def answers_of(bus: ServoBus, calls: list[Callable[[], object]]) -> dict[bytes, bytes]:
    """Return the servo's answer to each request of these calls. The driver alternates between two requests."""
    frames: list[SentBytes] = []
    bus.taps.append(frames.append)
    for call in calls * 4:
        call()
    bus.taps.clear()
    requests = [frame.data for frame in frames if frame.source is Sender.HOST]
    answers = [frame.data for frame in frames if frame.source is Sender.DEVICE]
    return dict(zip(requests, answers, strict=True))


def bare_read(servo: DynamixelServo, serial: SimSerial) -> Callable[[], None]:
    port, sdk = ClockedPort(serial, servo.bus.port.clock), Protocol2PacketHandler()

    def read() -> None:
        _, result, _ = sdk.readTxRx(port, 1, FIRST, SIZE)
        assert result == COMM_SUCCESS

    return read


def main() -> None:
    for name, repeated in (("simulated servo", False), ("repeated answer", True)):
        servo, serial, bus = opened()
        calls = [servo.read_state, bare_read(servo, serial)]
        if repeated:
            serial.record(answers_of(bus, calls))
        driver_us, bare_us = best_us(calls)
        ratio = driver_us / bare_us
        limit = "" if repeated else f" (at most {LIMIT})"
        print(
            f"status read of {SIZE} bytes, {name}: driver {driver_us:.0f} µs ({1e6 / driver_us:.0f} a second), "
            f"bare SDK {bare_us:.0f} µs ({1e6 / bare_us:.0f} a second): {ratio:.2f} ×{limit}; "
            f"at {LOOP_HZ} Hz {1e-4 * LOOP_HZ * driver_us:.2f} % of a processor, bare {1e-4 * LOOP_HZ * bare_us:.2f} %"
        )
        assert repeated or ratio <= LIMIT, f"{ratio:.2f} × the bare SDK's read"


if __name__ == "__main__":
    main()
