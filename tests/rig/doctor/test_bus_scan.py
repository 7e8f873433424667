"""Scans of servo buses and I2C buses: devices are found, never disturbed, and duplicate ids are detected."""

from dataclasses import replace
from errno import EBUSY, EIO, ENODEV, ENXIO, EREMOTEIO, ETIMEDOUT
from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.bench.computer import DeviceFile
from rig.config.imus import imu_kinds
from rig.core.errors import DeviceNotFound
from rig.core.next_steps import Do
from rig.devices.dynamixel.registers import model_numbers
from rig.devices.i2c import DESIGNWARE
from rig.devices.imu import open_imu
from rig.devices.v4l2 import CAPTURE, M2M, M2M_MPLANE, VideoMode, capabilities
from rig.doctor.device_scan import DeviceScan, camera_settings
from rig.doctor.examination import run_checks
from rig.doctor.finding import Severity
from rig.doctor.imu import scan_imus
from rig.doctor.servo_scan import BAUD_RATES, BaudScan, scan_servos
from sim.faults import Fault, Faults
from tests.fuzzing import fuzz_settings
from tests.rig.doctor.doctor_parts import unopened

PING, READ = 0x01, 0x02


def heard(bench, *bauds: int) -> list[BaudScan]:
    return scan_servos(bench.devices.adapter, bench.context.computer.clock, bauds or BAUD_RATES)


places = st.tuples(
    st.integers(0, 252), st.sampled_from(BAUD_RATES), st.sampled_from(["xl430_w250", "xm430_w350", "mx_28"])
)


@fuzz_settings(0.02)
@given(st.dictionaries(places.map(lambda place: place[:2]), places.map(lambda place: place[2]), min_size=1, max_size=4))
def test_every_servo_is_found_at_its_id_and_baud_rate(placed):
    (first, _), *others = placed.items()
    with unopened(servo_at=first) as bench:
        for (bus_id, baud), model in others:
            bench.add_servo(bus_id, baud, model)
        before = bench.devices.adapter.baudrate
        all_heard = heard(bench)
        found = {(s.bus_id, s.baud): s.model for h in all_heard for s in h.servos}
        assert found == {**placed, first: "xl430_w250"}
        assert not any(h.duplicate_ids or h.noise for h in all_heard)
        assert bench.devices.adapter.baudrate == before
        assert bench.instructions <= {PING, READ}


@fuzz_settings(0.01)
@given(st.integers(0, 252), st.sampled_from(BAUD_RATES))
def test_duplicate_id_is_found_at_any_rate(bus_id, baud):
    with unopened(servo_at=(bus_id, baud)) as bench:
        bench.add_servo(bus_id, baud, "xm430_w350")
        (said,) = heard(bench, baud)
        assert said.duplicate_ids == (bus_id,)
        assert bus_id not in {servo.bus_id for servo in said.servos}


def test_duplicate_id_is_found_beside_another_servo(bench):
    bench.add_servo(1, 57_600)
    bench.add_servo(7, 57_600)
    (said,) = heard(bench, 57_600)
    assert said.duplicate_ids == (1,)
    assert [servo.bus_id for servo in said.servos] == [7]


@pytest.mark.parametrize(("fault", "ids", "noise"), [("babble", [], True), ("echo", [1], False)])
def test_babbling_bus_is_noise_and_an_echo_changes_nothing(fault, ids, noise, bench):
    faults = Faults(bench.devices)
    faults.schedule(Fault.parse(fault))
    (said,) = heard(bench, 57_600)
    faults.clear()
    assert [servo.bus_id for servo in said.servos] == ids
    assert bool(said.noise) is noise
    assert not said.duplicate_ids


def test_bytes_after_each_request_are_noise_and_the_scan_stays_short(bench):
    class Glitch(type(bench.devices.adapter)):
        """An adapter that adds a byte when it begins to receive."""

        def write(self, data):
            super().reset_input_buffer()
            self.added = b"\0"
            return super().write(data)

        def read(self, size=1):
            added, self.added = getattr(self, "added", b""), b""
            return added or super().read(size)

    bench.devices.adapter.__class__ = Glitch
    (said,) = heard(bench, 57_600)
    assert [servo.bus_id for servo in said.servos] == [1]
    assert said.noise
    assert not said.duplicate_ids
    assert bench.context.computer.clock.now_ns() < 10e9  # each of eight rates takes no longer


def test_servo_with_a_corrupt_answer_is_asked_again(bench):
    spoiled = []

    def spoil(frame):
        if spoiled:
            return frame
        spoiled.append(frame)
        return replace(frame, data=frame.data[:-1] + bytes([frame.data[-1] ^ 1]))

    bench.devices.servo_bus.filters.append(spoil)
    (said,) = heard(bench, 57_600)
    assert [servo.bus_id for servo in said.servos] == [1]
    assert not said.duplicate_ids


def test_port_without_a_baud_rate_has_one_servo():
    class Relay:
        """A pseudo-terminal: the bytes arrive at any configured rate."""

        def __init__(self, wire):
            self.wire, self.baudrate = wire, wire.baudrate

        def __getattr__(self, name):
            return getattr(self.wire, name)

    with unopened() as bench:
        (once,) = scan_servos(Relay(bench.devices.adapter), bench.context.computer.clock, preferred=115_200)
        assert (once.baud, len(once.servos)) == (115_200, 1)
        bench.add_servo(1, 1_000_000)
        assert len(heard(bench)) == 8  # two servos of one kind, at two rates


def test_unsupported_rates_are_left_out():
    class Slow:
        """An adapter that stops at 1 MBd."""

        def __init__(self, wire):
            self.__dict__["wire"] = wire

        def __getattr__(self, name):
            return getattr(self.wire, name)

        def __setattr__(self, name, value):
            if name == "baudrate" and value > 1_000_000:
                raise ValueError(value)
            setattr(self.wire, name, value)

    with unopened() as bench:
        rates = [said.baud for said in scan_servos(Slow(bench.devices.adapter), bench.context.computer.clock)]
        assert rates == [57_600, 1_000_000, 115_200, 9_600]


def test_unknown_model_is_named_by_its_number(bench):
    bench.devices.servo.memory["Model Number"] = 4711
    assert 4711 not in model_numbers()
    ((servo,),) = (said.servos for said in heard(bench, 57_600))
    assert servo.model is None
    assert "unknown model 4711" in str(servo)


# -- I2C --------------------------------------------------------------------------------------------------------------


class RegisterFile:
    """A device that answers with what its registers hold."""

    def __init__(self, registers: dict[int, int]) -> None:
        self.registers = registers
        self.written: list[bytes] = []
        self.pointer = 0

    def start(self, reading: bool) -> None: ...

    def write(self, data: bytes) -> int:
        self.pointer = data[0]
        self.written.append(data)
        return len(data)

    def read(self, count: int) -> bytes:
        return bytes(self.registers.get(self.pointer + i, 0) for i in range(count))

    def stop(self) -> None: ...


@pytest.mark.parametrize("kind", imu_kinds().values(), ids=lambda kind: kind.key)
def test_each_imu_is_identified_at_each_address(kind):
    for address, identity in product(kind.addresses, kind.identities):
        with unopened() as bench:
            bench.devices.i2c.detach(0x68)
            device = RegisterFile({kind.register: identity})
            bench.devices.i2c.attach(address, device)
            (found,) = scan_imus(bench.context.computer, 1)
            assert (found.name, found.driver, found.address) == (kind.name, kind.key if kind.driver else None, address)
            assert all(len(data) == 1 for data in device.written)  # a register's number, never a value


def test_unknown_chip_is_reported_and_other_addresses_are_not_asked(bench):
    bench.devices.i2c.detach(0x68)
    clock, memory = RegisterFile({0x00: 0x37}), RegisterFile({})
    bench.devices.i2c.attach(0x68, clock)
    bench.devices.i2c.attach(0x50, memory)
    (found,) = scan_imus(bench.context.computer, 1)
    assert found.driver is None
    assert "register 0x00 is 0x37" in str(found)
    assert not memory.written
    (named, _) = DeviceScan().find_imus(bench.context)
    assert (named.code, named.level) == ("no_driver", Severity.WARNING)  # it may be a clock beside the sensor


@pytest.mark.parametrize(
    ("number", "code"), [(ETIMEDOUT, "i2c_stuck"), (EIO, "i2c_failed")], ids=["Raspberry Pi", "USB"]
)
def test_stuck_bus_is_reported_once_with_its_error(number, code, bench):
    bench.devices.i2c.stuck, bench.devices.i2c.stuck_error = True, number
    assert {found.errno for found in scan_imus(bench.context.computer, 1)} == {number}
    codes = [f.code for f in run_checks(bench.context, DeviceScan().checks) if f.topic == "imu"]
    assert codes == [code, "no_imu_found"]


@pytest.mark.parametrize("adapter", [DESIGNWARE, "bcm2835 (i2c@7e804000)"])
def test_controller_that_hangs_and_stuck_bus_are_distinguished_by_the_adapter(adapter, bench):
    bench.devices.i2c.stuck, bench.devices.i2c.name = True, adapter
    hangs = adapter == DESIGNWARE
    problem = bench.problem("imu")
    assert problem.code == ("i2c_hangs" if hangs else "i2c_stuck")
    assert ("off for 10 seconds" in problem.fix) == hangs
    bench.devices.i2c.stuck = False
    bench.devices.i2c.errors = dict.fromkeys((0x28, 0x29, 0x69, 0x6A, 0x6B), ETIMEDOUT)
    assert not any(found.hangs for found in scan_imus(bench.context.computer, 1))  # one sensor answers


@pytest.mark.parametrize("number", [ENXIO, EREMOTEIO, ENODEV, EIO, ETIMEDOUT])
def test_error_of_one_address_does_not_end_the_scan(number, bench):
    bench.devices.i2c.errors[0x28] = number
    found = {one.address: one for one in scan_imus(bench.context.computer, 1)}
    assert found[0x68].driver == "mpu6050"
    assert (0x28 in found) == (number in (EIO, ETIMEDOUT))  # the others mean that no device acknowledges


def test_kernel_driver_that_uses_the_address_is_named_with_the_command_that_unbinds_it(bench):
    bench.devices.i2c.kernel_drivers.add(0x68)
    bench.computer.i2c_driver("inv-mpu6050-i2c")
    problem = bench.problem("imu")
    assert (problem.code, problem.evidence["driver"]) == ("kernel_driver", "inv-mpu6050-i2c")
    assert problem.fix == "echo 1-0068 | sudo tee /sys/bus/i2c/drivers/inv-mpu6050-i2c/unbind"
    with pytest.raises(DeviceNotFound, match="kernel driver") as caught:
        open_imu(bench.context.config.imu, bench.devices.i2c.path, bench.devices.world.clock)
    assert caught.value.evidence["errno"] == EBUSY


def test_buses_of_monitors_are_not_scanned():
    with unopened(plugged=False) as bench:
        bench.computer.i2c_bus(20, "fef04500.i2c", compatible="brcm,bcm2711-hdmi-i2c")
        bench.computer.i2c_bus(6, "107d508200.i2c")
        bench.computer.link("sys/class/drm/card1-HDMI-A-1/ddc", bench.computer.root / "sys/class/i2c-dev/i2c-6")
        assert bench.context.computer.i2c_buses() == []
        assert [bus.path for bus in bench.context.computer.i2c_buses(6)] == ["/dev/i2c-6"]
        bench.computer.i2c_bus(1)
        assert [bus.path for bus in bench.context.computer.i2c_buses()] == ["/dev/i2c-1"]


def test_converters_and_metadata_are_not_cameras():
    with unopened(plugged=False) as bench:
        bench.computer.camera(0, "HD Webcam")
        bench.computer.camera(1, "HD Webcam metadata", capabilities=0x0080_0000)  # V4L2_CAP_META_CAPTURE
        bench.computer.camera(10, "bcm2835-codec-decode", capabilities=M2M_MPLANE)
        bench.computer.camera(14, "bcm2835-isp-capture0", capabilities=CAPTURE)
        bench.computer.camera(20, "a converter", capabilities=CAPTURE | M2M)
        assert [node.path for node in bench.context.computer.cameras()] == ["/dev/video0"]
        scan = DeviceScan()
        assert [f.level for f in run_checks(bench.context, scan.checks) if f.topic == "camera"] == [Severity.FINE]


def test_file_that_is_no_video_device_has_no_capabilities(tmp_path):
    (tmp_path / "video0").write_text("")
    assert capabilities(tmp_path / "video0") is None
    assert capabilities(tmp_path / "video1") is None


def test_mode_of_a_camera_is_chosen_from_what_it_offers():
    node = DeviceFile("/dev/video2", "Cam", None, "video", True, ())
    hd = (VideoMode("YUYV", 1280, 720, 10.0), VideoMode("MJPG", 1280, 720, 20.0), VideoMode("MJPG", 1920, 1080, 30.0))
    assert camera_settings(node, hd) == {
        ("camera", "source"): 2,
        ("camera", "width"): 1280,
        ("camera", "height"): 720,
        ("camera", "fps"): 20.0,
    }
    usual = VideoMode("YUYV", 640, 480, 30.0)
    assert camera_settings(node, (*hd, usual)) == {("camera", "source"): 2}
    assert camera_settings(node) == {("camera", "source"): 2}


def test_doctor_names_the_nearest_mode():
    with unopened("camera.width=1280", "camera.height=720") as bench:
        problems = bench.problems("camera")
        assert problems["mode_not_offered"] == (Do.SETUP(),)


def test_bus_that_does_not_wait_for_a_bno055_is_reported_with_the_slower_one():
    with unopened("imu.model=bno055") as bench:
        bench.devices.i2c.stretch_errors = 0.2
        bench.devices.world.clock.sleep(2.0)
        assert any("i2c_arm_baudrate=10000" in str(fix) for fix in bench.problems("imu").values())
