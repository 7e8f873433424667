"""Findings of `rig doctor`: each problem is found with its fix, and stops no other check."""

import sqlite3
import threading
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import pytest

from rig.calibrations import CalibrationResult, CalibrationStatus, CalibrationStore
from rig.catalog import Catalog
from rig.core.clock import SystemClock
from rig.core.errors import ConfigError, DeviceMismatch, DeviceNotFound, DeviceSilent
from rig.core.next_steps import Do
from rig.doctor.checks import CHECKS
from rig.doctor.device_scan import DeviceScan
from rig.doctor.examination import Check, run_checks
from rig.doctor.finding import Severity, fine
from rig.doctor.servo_scan import BaudScan
from sim.faults import Fault, Faults, fault_kinds
from tests.rig.calibrations.test_calibrations import RESULT
from tests.rig.catalog.catalog_samples import fill
from tests.rig.doctor.doctor_parts import unopened

PING, READ = 0x01, 0x02


def set_up(bench) -> None:
    """Give the servo the settings that the rig needs."""
    for name, value in {"Operating Mode": 4, "Return Delay Time": 0}.items():
        bench.devices.servo.memory[name] = value


def test_only_the_missing_calibration_of_a_new_bench_is_reported(bench):
    set_up(bench)
    findings = bench.findings()
    assert {f.topic for f in findings} == {check.topic for check in CHECKS}
    (problem,) = [f for f in findings if f.level is not Severity.FINE]
    assert (problem.topic, problem.code) == ("calibration", "never_calibrated")
    assert problem.steps == (Do.CALIBRATE(name="imu"),)
    assert bench.instructions <= {PING, READ}  # nothing is written, so nothing can move


def test_empty_computer_reports_each_missing_device():
    with unopened(plugged=False) as bench:
        bench.devices.adapter.unplug()
        bench.devices.camera.unplug()
        bench.devices.i2c.detach(0x68)
        findings = bench.findings()
        bad = {f.topic for f in findings if f.level is Severity.BAD}
        assert bad == {"port", "servo", "imu", "camera"}
        assert all(f.fix for f in findings if f.level is not Severity.FINE)
        assert {f.topic for f in findings if f.level is Severity.FINE} >= {"bench", "disk", "catalog"}


# -- the servo --------------------------------------------------------------------------------------------------------


def test_torque_watchdog_and_factory_settings_are_reported_and_not_changed(bench):
    memory = bench.devices.servo.memory
    assert bench.problems("servo") == {"setting_differs": (Do.SERVO_SETTINGS(),)}
    differing = [f.evidence for f in bench.findings("servo") if f.code == "setting_differs"]
    values = {one["register"]: (one["found"], one["wanted"]) for one in differing}
    assert (values["Operating Mode"], values["Return Delay Time"]) == ((3, 4), (250, 0))
    memory["Torque Enable"], memory["Bus Watchdog"] = 1, 0xFF
    assert {"torque_on", "watchdog_tripped"} < set(bench.problems("servo"))
    assert (memory["Torque Enable"], memory["Operating Mode"]) == (1, 3)


@pytest.mark.parametrize("place", [(3, 57_600), (1, 1_000_000)])
def test_servos_at_another_id_or_rate_are_found(place):
    with unopened(servo_at=place) as bench:
        problem = bench.problem("servo")
        assert (problem.code, problem.steps) == ("other_servos", (Do.SETUP(),))
        assert [(found.bus_id, found.baud) for found in problem.evidence["found"]] == [place]
        bench.add_servo(4, 115_200)
        assert len(bench.problem("servo").evidence["found"]) == 2


def test_second_servo_is_reported_and_duplicate_id_is_bad(bench):
    set_up(bench)
    bench.add_servo(7, 57_600)
    assert not bench.problems("servo")
    (more,) = (f for f in bench.findings("servo") if f.code == "more_servos")
    assert [found.bus_id for found in more.evidence["found"]] == [7]
    bench.add_servo(1, 57_600)
    problem = bench.problem("servo")
    assert (problem.code, problem.evidence["ids"]) == ("duplicate_id", (1,))
    assert problem.steps[1:] == (Do.SERVO_ID(id=2),)


def test_other_model_can_be_configured():
    with unopened("servo.model=xm430_w350") as bench:
        bench.devices.servo_bus.detach(bench.devices.servo)
        bench.add_servo(1, 57_600, "xl430_w250")
        assert Do.SET_KEY(key="servo.model", value="xl430_w250") in bench.problem("servo").steps


# -- all simulated faults ---------------------------------------------------------------------------------------------

FOUND = {
    "servo.off": ("servo", "no_servo"),
    "servo.stuck": ("servo", "servo_frozen"),
    "servo.garbage": ("servo", 404),
    "servo.slow": ("servo", "slow_readings"),
    "servo.intermittent": ("servo", "readings"),
    "crc_flip": ("servo", "readings"),
    "late_reply": ("servo", "readings"),
    "babble": ("servo", "foreign_bytes"),
    "unplug": ("servo", 400),
    "duplicate_id": ("servo", "duplicate_id"),
    "wrong_model": ("servo", 401),
    "brownout": ("servo", "no_servo"),
    "overload": ("servo", "hardware_error"),
    "overheat": ("servo", "hardware_error"),
    "imu.off": ("imu", "no_imu"),
    "imu.stuck": ("imu", "imu_frozen"),
    "imu.garbage": ("imu", "noisy"),
    "imu.slow": ("imu", "samples_missing"),
    "imu_saturated": ("imu", "saturated"),
    "i2c_stuck": ("imu", "i2c_stuck"),
    "i2c_hang": ("imu", "i2c_hangs"),
    "camera.off": ("camera", 400),
    "camera.stuck": ("camera", 402),
    "camera.garbage": ("camera", "view_rejected"),
    "camera.wrong": ("camera", 404),
    "camera.slow": ("camera", "few_frames"),
    "camera.delayed": ("camera", "late_frames"),
    "frozen_frame": ("camera", "camera_frozen"),
    "black_frame": ("camera", "black"),
    "light_flicker": ("camera", "flicker"),
}
"""Faults that show while nothing moves: the topic and the code of the finding, or of its error."""

IN_IMAGES = {"frozen_frame", "black_frame", "blur", "exposure_jump", "light_flicker", "object_falls"}
"""Faults that only the camera may show. The camera is not checked for other faults, because its frames take time."""


INVISIBLE = sorted(fault_kinds().keys() - FOUND.keys())


@pytest.mark.parametrize(
    "name", [*FOUND, INVISIBLE[0], *(pytest.param(name, marks=pytest.mark.nightly) for name in INVISIBLE[1:])]
)
def test_all_checks_end_under_every_fault_and_find_visible_ones(name, bench):
    set_up(bench)
    faults = Faults(bench.devices)
    faults.schedule(Fault.parse(name))
    seen = name.startswith("camera") or name in IN_IMAGES
    findings = bench.findings("port", "servo", "imu", "clock", *(["camera"] if seen else []))
    faults.clear()
    problems = [f for f in findings if f.level is not Severity.FINE]
    assert all(f.fix for f in problems)
    assert not {"check_failed", "check_timed_out"} & {f.code for f in findings}
    if name in FOUND:
        topic, code = FOUND[name]
        assert any(f.topic == topic and code in (f.code, f.evidence.get("error_code")) for f in problems), problems
        others = {f.topic for f in problems} - {topic}
        assert not others


@pytest.mark.parametrize(
    ("topic", "code", "level", "spoil"),
    [
        ("servo", "supply", Severity.WARNING, lambda parts: parts.servo.set_voltage(13.8)),
        ("servo", "supply", Severity.BAD, lambda parts: parts.servo.set_voltage(14.5)),
        ("servo", "temperature", Severity.BAD, lambda parts: parts.servo.set_temperature(70)),
        ("imu", "noisy", Severity.BAD, lambda parts: Faults(parts).schedule(Fault.parse("imu.garbage"))),
        ("imu", "large_bias", Severity.BAD, lambda parts: setattr(parts.imu.inertial, "gyro_bias_dps", 30.0)),
        ("imu", "wrong_gravity", Severity.BAD, lambda parts: setattr(parts.imu.inertial, "accel_bias_g", 0.7)),
    ],
)
def test_values_beyond_a_limit_are_bad_and_close_to_it_a_warning(topic, code, level, spoil, bench):
    set_up(bench)
    spoil(bench.devices)
    assert (code, level) in {(f.code, f.level) for f in bench.findings(topic)}


# -- the IMU ----------------------------------------------------------------------------------------------------------


def test_camera_is_reported_as_locked_only_by_settings_that_were_read_back():
    def camera(*settings):
        with unopened(*settings) as bench:
            return {f.code: f for f in bench.findings("camera")}

    locked = camera()["locked"].evidence["settings"]
    assert locked[:4] == ["exposure_us 10000", "white_balance_k 5000", "gain 0", "focus 120"]
    assert "dynamic_frame_rate 0" in locked
    found = camera("camera.gain=none", "camera.sharpness=999")
    assert found["not_locked"].evidence["settings"] == ["gain"]
    assert found["setting_rejected"].evidence["setting"] == "sharpness"
    assert not [text for text in found["locked"].evidence["settings"] if text.startswith(("gain", "sharp"))]


def test_imu_of_another_address_axis_or_kind_is_found():
    with unopened("imu.address=0x69") as bench:
        device = bench.devices.i2c.detach(0x69)
        bench.devices.i2c.attach(0x68, device)
        assert bench.problem("imu").steps == (Do.SETUP(),)
    with unopened("imu.model=bno055") as bench:
        bench.context.computer.clock.sleep(1.0)  # it is silent for a while after power-up
        assert not bench.problems("imu")
    with unopened("imu.axis=x") as bench:
        assert bench.problem("imu").steps == (Do.SET_KEY(key="imu.axis", value="z"),)
    with unopened() as bench:
        bench.devices.imu.who_am_i = 0x70
        problem = bench.problem("imu")
        assert (problem.code, problem.evidence["found"].name) == ("other_imu", "MPU-6500")
        assert problem.steps == (Do.SETUP(),)
        bench.devices.imu.who_am_i = 0x73
        assert bench.problem("imu").code == "no_driver"


def test_clone_is_checked_and_named():
    with unopened("imu.model=mpu6050_clone") as bench:
        bench.devices.imu.who_am_i = 0x98
        assert not bench.problems("imu")
        (named,) = (f for f in bench.findings("imu") if f.code == "imu")
        assert (named.evidence["model"], named.evidence["who_am_i"]) == ("MPU-6050 clone", 0x98)
        assert "imu_note" in {f.code for f in bench.findings("imu")}


@pytest.mark.parametrize("model", ["mpu6050", "mpu6050_clone"])
def test_imu_on_a_rig_head_is_checked(model):
    with unopened("imu.connection=head", "head.port=/dev/ttyUSB1", f"imu.model={model}") as bench:
        set_up(bench)
        bench.computer.serial_port("ttyUSB1", serial="HEAD")
        assert not bench.problems("port", "servo", "imu")
        codes = {f.code for f in bench.findings("imu")}
        assert "head" in codes
        assert ("imu_note" in codes) == (model == "mpu6050_clone")
        bench.devices.head.unplugged = True
        assert bench.problem("imu").evidence["error_code"] == DeviceNotFound.code


def test_search_names_the_sensor_on_a_rig_head():
    with unopened("imu.connection=head", "head.port=/dev/ttyUSB1") as bench:
        set_up(bench)
        bench.computer.serial_port("ttyUSB1", serial="HEAD")
        bench.devices.imu.who_am_i = 0x70
        scan = DeviceScan()
        found = [one for one in scan.find_servos(bench.context) if one.code == "head"]
        assert [one.evidence["model"] for one in found] == ["MPU-6500"]
        assert scan.settings["imu", "model"] == "mpu6500"
        bench.devices.imu.who_am_i = 0x00
        codes = {one.evidence.get("error_code") for one in DeviceScan().find_servos(bench.context)}
        assert DeviceMismatch.code in codes


def test_search_finds_a_rig_head_that_sends_all_the_time(monkeypatch):
    with unopened("imu.connection=head", "head.port=/dev/ttyUSB1") as bench:
        bench.computer.serial_port("ttyUSB1", serial="HEAD")
        before = bench.context.config.imu.model_copy(update={"connection": "i2c"})  # it is not configured yet
        bench.context.config = bench.context.config.model_copy(update={"imu": before})
        monkeypatch.setattr("rig.doctor.device_scan.scan_servos", lambda *_, **__: [BaudScan(57_600, noise=True)])
        assert [one.code for one in DeviceScan().find_servos(bench.context)] == ["foreign_bytes", "head"]


def test_servo_behind_the_relay_is_not_reported_missing():
    with unopened("imu.connection=head", "head.port=/dev/ttyUSB1", "head.power=true") as bench:
        assert bench.problem("servo").code == "supply_switched"


# -- stored data ----------------------------------------------------------------------------------------------------


def enroll(path: Path, views: int) -> None:
    with Catalog.open(path, clock=SystemClock()) as catalog:
        fill(catalog, "mug", views)


def test_catalog_is_checked(bench):
    assert bench.findings("catalog")[0].code == "no_catalog"
    path = bench.context.config.catalog_path("sim")
    enroll(path, 6)
    (finding,) = bench.findings("catalog")
    assert (finding.level, finding.code) == (Severity.FINE, "catalog")
    assert (finding.evidence["objects"], finding.evidence["views"]) == (1, 6)
    image = next((path / "images").rglob("*.png"))
    image.write_bytes(b"no image")
    problem = bench.problem("catalog")
    assert (problem.code, problem.steps) == ("images_damaged", (Do.VERIFY_CATALOG(),))
    assert (problem.evidence["broken"], problem.evidence["images"]) == (1, 6)
    image.unlink()
    (path / "catalog.sqlite").write_bytes(b"SQLite format 3\0" + b"rubbish" * 999)
    (finding,) = bench.findings("catalog")
    assert finding.level is Severity.BAD
    assert finding.exit_code == 7


def test_catalog_with_orphaned_rows_is_damaged(bench):
    path = bench.context.config.catalog_path("sim")
    enroll(path, 4)
    with sqlite3.connect(path / "catalog.sqlite") as connection:
        connection.execute("PRAGMA foreign_keys = off")
        connection.execute("DELETE FROM sessions")
    connection.close()
    assert "database_damaged" in bench.problems("catalog")


def result(bench, days_ago: float, valid_days: float | None = None, **device: object) -> CalibrationResult:
    when_utc = bench.context.computer.clock.utc() - timedelta(days=days_ago)
    return replace(RESULT, when_utc=when_utc, device=device, valid_days=valid_days)


def test_delay_inside_the_camera_is_reported_as_unknown_before_its_calibration():
    with unopened() as bench:
        (found,) = (f for f in bench.findings("calibration") if f.level is Severity.FINE)
        assert (found.code, found.steps) == ("camera_delay_unknown", (Do.CALIBRATE(name="camera-time"),))
    with unopened("camera_time.offset_ms=-90") as bench:
        assert "camera_delay_unknown" not in {f.code for f in bench.findings("calibration")}


def test_missing_expired_and_other_device_calibrations_are_warnings(bench):
    set_up(bench)
    store = CalibrationStore(bench.context.config.calibration_path("sim"))
    assert bench.problem("calibration").code == "never_calibrated"
    store.add(result(bench, 100, valid_days=30))
    problem = bench.problem("calibration")
    assert problem.evidence["status"] is CalibrationStatus.EXPIRED
    assert problem.evidence["calibration"].age_days == pytest.approx(100, abs=0.1)
    assert problem.steps == (Do.CALIBRATE(name="imu"),)
    store.add(result(bench, 1, imu={"who_am_i": 0x99}))
    bench.findings("servo", "imu")  # the devices are known only after their checks
    assert bench.problem("calibration").evidence["status"] is CalibrationStatus.EXPIRED
    for path in store.folder.glob("*.json"):
        path.unlink()
    store.add(result(bench, 1, imu={"who_am_i": 0x99}))
    problem = bench.problem("calibration")
    assert problem.evidence["status"] is CalibrationStatus.OTHER_DEVICE
    assert problem.evidence["calibration"].changes == ("imu.who_am_i was 153, is 104",)
    store.add(result(bench, 0.5, valid_days=30))
    assert not bench.problems("calibration")
    (store.folder / "20260430T000000.000000Z-imu.scale.json").write_text("{")
    assert bench.problem("calibration").evidence["error_code"] == ConfigError.code


# -- the examination itself -------------------------------------------------------------------------------------------


def test_hanging_or_failing_check_stops_no_other():
    released, only = threading.Event(), fine("only_servo", "the only servo on its bus")

    def hangs(context):
        yield only
        released.wait()
        yield only

    def silent(context):
        raise DeviceSilent("No answer.", next_step="Knock.")
        yield

    def pulled(context):
        yield only
        raise OSError(5, "Input/output error")

    def broken(context):
        yield from ()
        raise KeyError("oh")

    checks = [
        Check("hangs", hangs, deadline_s=0.05),
        Check("silent", silent),
        Check("pulled", pulled),
        Check("broken", broken),
        Check("well", lambda _: iter([only])),
    ]
    with unopened() as bench:
        findings = list(run_checks(bench.context, checks))
    released.set()
    assert [(f.topic, f.code, f.steps, f.exit_code) for f in findings] == [
        ("hangs", "only_servo", (), 0),
        ("hangs", "check_timed_out", ("Unplug the device, plug it in again, and start over",), 9),
        ("silent", "error", ("Knock.",), 4),
        ("pulled", "only_servo", (), 0),
        ("pulled", "check_interrupted", (Do.DOCTOR(),), 4),
        ("broken", "check_failed", (Do.REPORT_DEFECT(),), 1),
        ("well", "only_servo", (), 0),
    ]
