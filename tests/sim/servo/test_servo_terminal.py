"""Simulated servos as a program sees them that knows neither the SDK nor the simulation: a terminal, in real time."""

from pathlib import Path

import pytest

from rig.core.clock import SystemClock
from tests.sim.servo.served import start


@pytest.mark.nightly
def test_rustypot_drives_an_xl430(tmp_path: Path) -> None:
    rustypot = pytest.importorskip("rustypot")
    process = start(tmp_path / "servo", 1, 4)
    servo = rustypot.Xl430PyController(str(tmp_path / "servo"), 1_000_000, 30.0)
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
    process.close()
