"""The emulated rig head as another program sees it: a real (pseudo) terminal, real time."""

from contextlib import closing
from threading import Thread

import pytest

from rig.core.clock import SystemClock, seconds_between
from rig.core.errors import DeviceSilent
from rig.devices.dynamixel.port import open_serial
from rig.devices.head.head import RigHead
from rig.devices.head.protocol import BAUD
from sim.head.serial_port import HeadSerial
from sim.imu.mpu6050 import SimMpu6050
from sim.motion import to_velocity
from sim.noise import NoiseModel
from sim.realtime.pace import RealTime
from sim.realtime.port import PtyPort
from sim.world import World
from tests.contract.heads import head_of, mpu6050

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


def check_head(port, monkeypatch):
    """Read a head that rotates at 30 deg/s, through pyserial on a port."""
    clock = SystemClock()
    wire = open_serial(port, BAUD, "head")
    head = answering(lambda: RigHead(wire, clock, mpu6050(), deadman_s=2.0), clock)
    monkeypatch.setattr("rig.devices.head.link.REPLY_S", 2.0)  # the other program may have to wait
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


def test_program_with_pyserial_finds_the_emulated_binary(monkeypatch):
    world = World(seed=0)
    with closing(head_of("avr", world)) as head:
        sensor = SimMpu6050(head.world_at_board_time)
        head.attach(sensor.address, sensor)
        world.drive(to_velocity(0.0, 0.0, 30.0, 30.0, 100.0))
        port = PtyPort(lambda: HeadSerial(head))
        time = RealTime(world.clock, [port])
        thread = Thread(target=time.run)
        thread.start()
        try:
            check_head(port.path, monkeypatch)
        finally:
            time.over = True
            thread.join()
            port.close()
