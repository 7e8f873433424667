"""`rig sim-head` as another program sees it: a real process, a real (pseudo) terminal, real time."""

import json

import pytest

from rig.core.clock import SystemClock, seconds_between
from rig.core.errors import DeviceSilent
from rig.devices.dynamixel.port import open_serial
from rig.devices.head.head import RigHead
from rig.devices.head.protocol import BAUD
from sim.noise import NoiseModel
from tests.contract.heads import mpu6050, needs
from tests.programs import Program

PATIENCE_S = 100.0


def answering(connect, clock):
    """Connect again until the head answers: the other process may have to wait for a processor."""
    started_ns = clock.now_ns()
    while True:
        try:
            return connect()
        except DeviceSilent:
            if seconds_between(started_ns, clock.now_ns()) > PATIENCE_S:
                raise


@pytest.mark.parametrize("kind", ["memory", "avr"])
def test_program_with_pyserial_finds_a_head(kind, tmp_path, monkeypatch):
    needs(kind)
    arguments = ("--json", "--kind", kind, "--spin", "30", "--seconds", "600", "--link", "head")
    program = Program("sim-head", *arguments, folder=tmp_path)
    try:
        started = json.loads(program.stdout.readline())
        assert started["kind"] == kind
        assert (tmp_path / "head").resolve() == (tmp_path / started["port"]).resolve()
        clock = SystemClock()
        wire = open_serial(str(tmp_path / "head"), BAUD, "head")
        head = answering(lambda: RigHead(wire, clock, mpu6050(), deadman_s=2.0), clock)
        monkeypatch.setattr("rig.devices.head.link.REPLY_S", 2.0)  # the other process may have to wait
        clock.sleep(0.3)
        head.read_samples()
        clock.sleep(0.5)
        samples = head.read_samples()
        assert samples.lost == 0
        assert len(samples.time_ns) > 20
        ripple_dps = 30 * NoiseModel().speed_ripple
        assert samples.gyro_dps[:, 2] - samples.gyro_dps[:, 2].mean() == pytest.approx(0.0, abs=0.5 + ripple_dps)
        assert 20 < samples.gyro_dps[:, 2].mean() < 40  # 30, and the zero of an uncalibrated gyro
        head.close()
    finally:
        program.close()
