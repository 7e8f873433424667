"""Simulated servos as other programs see them: a real process, a real (pseudo) terminal, real time."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from dynamixel_sdk import COMM_SUCCESS, PortHandler, Protocol2PacketHandler

from rig.config import ServoConfig
from rig.core.clock import SystemClock
from rig.devices.dynamixel.port import open_serial
from rig.devices.dynamixel.servo import open_servo
from rig.devices.servo import MotionProfile
from tests.programs import Program
from tests.sim.servo.served import start


@pytest.fixture
def serving(tmp_path: Path) -> Iterator[Callable[..., str]]:
    """Return a function that starts servos in another process and returns their port, a link of a fixed name."""
    running: list[Program] = []

    def serve(*ids: int) -> str:
        running.append(start(tmp_path / "servo", *ids))
        return str(tmp_path / "servo")

    yield serve
    for process in running:
        process.close()


@pytest.mark.nightly
def test_rustypot_drives_an_xl430(serving: Callable[..., str]) -> None:
    rustypot = pytest.importorskip("rustypot")
    port = serving(1, 4)
    servo = rustypot.Xl430PyController(port, 1_000_000, 30.0)
    assert [servo.ping(i) for i in (1, 4)] == [True, True]
    assert servo.read_model_number(1) in (1060, [1060])
    servo.write_operating_mode(1, 4)
    servo.write_torque_enable(1, 1)
    servo.write_goal_position(1, 2700)
    clock, positions = SystemClock(), [0, 0]
    for _ in range(200):
        positions = [one for number in (1, 4) for one in servo.read_present_position(number)]
        if abs(positions[0] - 2700) < 4:
            break
        clock.sleep(0.02)
    assert positions == pytest.approx([2700, 2048], abs=4)
    servo.close()


def test_sdk_and_rig_driver_find_the_servo(serving: Callable[..., str], monkeypatch: pytest.MonkeyPatch) -> None:
    """One after the other, through a link of a fixed name; in real time the driver moves it, and sees it move."""
    monkeypatch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", 30_000)  # ms: the other process may have to wait
    link = serving()
    port = PortHandler(link)
    assert port.openPort()
    assert Protocol2PacketHandler().ping(port, 1) == (1060, COMM_SUCCESS, 0)
    port.closePort()
    clock = SystemClock()
    wire = open_serial(link, 57_600)
    servo = open_servo(wire, ServoConfig(), clock)
    servo.prepare(write=True)
    servo.set_profile(MotionProfile(180.0, 2000.0))
    servo.torque_on()
    start_deg = servo.read_state().position_deg
    servo.arm_watchdog(2.5)
    servo.move_to(start_deg + 60.0)
    seen = []
    while not seen or (not servo.read_state().in_position and len(seen) < 200):
        clock.sleep(0.02)
        seen.append(servo.read_state().position_deg - start_deg)
    assert seen[-1] == pytest.approx(60.0, abs=1.0)
    assert any(5 < angle < 55 for angle in seen)
    assert servo.bus_statistics["retries"] == 0
    servo.torque_off()
    servo.close()
