"""The rig head's driver on the firmware itself: a disturbed connection, an unplugged cable, a faulty sensor."""

import numpy as np
import pytest
import serial

from rig.core.errors import (
    DeviceMismatch,
    DeviceSilent,
    HeartbeatLost,
    RequestRejected,
)
from rig.devices.head.head import RigHead
from rig.devices.head.link import HeadFrame, HeadLink, encode
from rig.devices.head.protocol import (
    BAUD,
    PROTOCOL_VERSION,
    Counters,
    Done,
    HeadState,
    Hello,
    Identity,
    Light,
    ReadCounters,
    SampleFlag,
)
from sim.clock import VirtualClock
from sim.head.board import SimHead
from sim.head.serial_port import HeadSerial
from sim.imu.mpu6050 import SimMpu6050
from sim.motion import to_velocity
from sim.noise import NoiseModel
from tests.contract.heads import AVR_NIGHTLY, counters, mpu6050, opened_head, switch_on

MS = 1_000_000


# -- a bad line ---------------------------------------------------------------------------------------------------


@AVR_NIGHTLY
def test_corrupt_frames_cost_samples_but_give_no_wrong_value(opened):
    rng = np.random.default_rng(1)
    opened.world.drive(to_velocity(opened.clock.now_ns() * 1e-9, 0.0, 60.0, 60.0, 1e3))
    opened.clock.sleep(0.5)
    opened.imu.read_samples()
    start_ns = opened.clock.now_ns()
    opened.head.filters.append(lambda _to_head, byte: byte ^ 0x20 if rng.random() < 0.002 else byte)
    rates, times, lost = [], [], 0
    for _ in range(50):
        opened.clock.sleep(0.1)
        samples = opened.imu.read_samples()
        rates.append(samples.gyro_dps)
        times.append(samples.time_ns)
        lost += samples.lost
    health = opened.imu.health()
    assert health["crc_errors"] > 0
    assert health["missed"] > 0
    assert lost > 0
    assert np.concatenate(rates)[:, 2] == pytest.approx(60.0, abs=0.05)
    elapsed_s = (opened.clock.now_ns() - start_ns) * 1e-9
    assert lost + sum(map(len, rates)) == pytest.approx(200 * elapsed_s, abs=6)
    assert all(np.diff(np.concatenate(times)) > 0)
    assert opened.imu.status.state is HeadState.ACTIVE  # a lost heartbeat is repeated in time


def test_late_reply_answers_no_other_request():
    with opened_head(noise=NoiseModel.none()) as h:
        h.imu._cancel()
        wire = HeadSerial(h.head)
        link = HeadLink(wire, h.clock, lambda _event: None, "head")
        link.start()
        h.head.filters.append(lambda to_head, byte: None if not to_head else byte)
        with pytest.raises(DeviceSilent):
            link.request(ReadCounters(), Counters, attempts=1)
        h.head.filters.clear()
        h.clock.sleep(0.1)
        link.poll()
        assert link.request(Hello(PROTOCOL_VERSION), Identity).protocol == PROTOCOL_VERSION


def test_repeated_request_is_carried_out_once(opened):
    """A head knows a repetition by its number: it does not read the body again."""
    link = opened.imu._link
    opened.imu._cancel()
    link.request(Light(200), Done)
    link._connection.write(encode(HeadFrame(Light.ID, link._sequence, bytes([5]))))
    opened.clock.sleep(0.05)
    opened.head.catch_up()
    assert opened.head.light == pytest.approx(200 / 255)


@AVR_NIGHTLY
def test_reply_that_arrived_while_the_computer_was_busy_is_accepted(opened, monkeypatch):
    opened.imu._cancel()  # no heartbeat in the pause
    wire = opened.imu._link._connection
    write = wire.write

    def write_and_pause(data: bytes) -> int:
        written = write(data)
        opened.clock.sleep(0.2)
        return written

    monkeypatch.setattr(wire, "write", write_and_pause)
    assert opened.imu._link.request(ReadCounters(), Counters, attempts=1).crc_errors == 0


def test_unknown_message_is_rejected(opened):
    class Future(Light, number=0x55, layout="<B"):
        pass

    with pytest.raises(RequestRejected, match="does not know this request"):
        opened.imu._link.request(Future(1), Done)


# -- a pulled cable -------------------------------------------------------------------------------------------------


def test_replugged_head_reconnects_with_outputs_off():
    with opened_head(noise=NoiseModel.none(), reopen=HeadSerial) as h:
        switch_on(h)
        h.clock.sleep(0.2)
        h.imu.read_samples()
        h.unplug()
        with pytest.raises(DeviceSilent, match="gone"):
            h.imu.read_samples()
        h.clock.sleep(1.0)
        with pytest.raises(DeviceSilent):
            h.imu.read_samples()
        h.head.unplugged = False
        h.clock.sleep(0.1)
        h.imu.read_samples()
        h.clock.sleep(0.5)
        samples = h.imu.read_samples()
        assert len(samples.time_ns) > 50
        assert h.imu.statistics.reconnects == 1
        assert not h.head.relay_closed
        assert isinstance(h.imu.fault, HeartbeatLost)


def test_different_head_after_replugging_is_rejected():
    with opened_head(noise=NoiseModel.none(), reopen=lambda _head: HeadSerial(other)) as h:
        other = SimHead(h.world, serial=2)
        other.attach(0x68, SimMpu6050(other.world_at_board_time))
        h.unplug()
        with pytest.raises(DeviceSilent):
            h.imu.read_samples()
        for _ in range(2):
            with pytest.raises(DeviceMismatch, match="a different one") as caught:
                h.imu.read_samples()
            assert caught.value.evidence["serial"] == {"got": 2, "expected": 1}
        other.close()


def test_port_in_use_is_reported():
    class Taken:
        baudrate = BAUD

        def write(self, data):
            raise serial.SerialException(5, "Input/output error")

        def close(self): ...

    clock = VirtualClock()
    with pytest.raises(DeviceSilent, match="gone"):
        RigHead(Taken(), clock, mpu6050())


# -- the sensor ------------------------------------------------------------------------------------------------------


@AVR_NIGHTLY
def test_lost_sensor_is_reported_and_recovered(opened):
    opened.clock.sleep(0.2)
    opened.imu.read_samples()
    opened.head.detach(0x68)
    opened.clock.sleep(0.2)
    opened.imu.read_samples()  # the head tries to set it up again
    opened.clock.sleep(1.0)
    with pytest.raises(DeviceSilent, match="does not answer"):
        opened.imu.read_samples()
    opened.sensor.power_cycle()
    opened.head.attach(0x68, opened.sensor)
    opened.clock.sleep(1.0)
    assert opened.imu.read_samples().lost > 200
    opened.clock.sleep(0.2)
    assert opened.imu.read_samples().lost == 0


def test_sensor_is_set_up_again_after_a_brown_out(opened):
    opened.clock.sleep(0.2)
    opened.imu.read_samples()
    opened.sensor.power_cycle()
    opened.clock.sleep(0.6)
    samples = opened.imu.read_samples()
    assert samples.lost == pytest.approx(0.2 * 200, abs=30)  # 50 ms to notice, 150 ms to start
    assert counters(opened).restarts == 1


@AVR_NIGHTLY
@pytest.mark.parametrize("clocks", [1, 9])
def test_stuck_bus_is_freed_without_losing_samples(opened, clocks):
    opened.clock.sleep(0.2)
    opened.imu.read_samples()
    opened.head.stuck = clocks
    opened.clock.sleep(0.5)
    samples = opened.imu.read_samples()
    assert samples.lost == 0
    found = counters(opened)
    assert (found.timeouts, found.recoveries) == (1, 1)


def test_permanently_stuck_bus_is_reported(opened):
    opened.head.stuck = True
    opened.clock.sleep(1.0)
    with pytest.raises(DeviceSilent, match="stuck"):
        opened.imu.read_samples()


@AVR_NIGHTLY
def test_unacknowledged_addresses_cost_no_sample(opened):
    opened.clock.sleep(0.2)
    opened.imu.read_samples()
    for _ in range(20):
        opened.head.nack(2)  # two in a row: the third attempt goes through
        opened.clock.sleep(0.05)
    assert opened.imu.read_samples().lost == 0
    assert counters(opened).nacks == 40


@AVR_NIGHTLY
def test_samples_without_data_ready_are_polled(opened):
    opened.sensor.next_edge_ns = lambda _after_ns: None  # INT is not wired
    opened.clock.sleep(0.3)
    opened.imu.read_samples()
    opened.clock.sleep(1.0)
    samples = opened.imu.read_samples()
    assert samples.lost == 0
    assert len(samples.time_ns) == pytest.approx(200, abs=4)
    assert all(np.diff(samples.time_ns) > 0)
    assert not opened.imu._stream.newest.flags & SampleFlag.EDGE
