"""Calibration results on disk, their status, and their effect on the configuration."""

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rig.calibrations import (
    CalibrationRejection,
    CalibrationResult,
    CalibrationStatus,
    CalibrationStore,
    Contribution,
    Estimate,
    RejectionCode,
    apply_results,
)
from rig.config import RigConfig, load_config
from rig.core.errors import ConfigError, UsageError
from rig.core.next_steps import Do


def scatter(uncertainty: float, unit: str = "1") -> tuple[Contribution, ...]:
    """Return a budget with one contribution."""
    return (Contribution("scatter", "A", uncertainty, unit),)


RESULT = CalibrationResult(
    name="imu.scale",
    estimates={"scale": Estimate(1.01, scatter(1e-4), "1")},
    residual=0.02,
    limit=0.1,
    residual_unit="°",
    rejections=(),
    when_utc=datetime(2026, 3, 1, 12, tzinfo=UTC),
    reference="encoder of the servo",
    operator="A. Silva",
    device={"bench": "sim", "imu": {"model": "MPU-6050"}},
    evidence={"legs": [{"encoder_deg": 360.0}]},
)

FEW = CalibrationRejection(
    RejectionCode.TOO_FEW_REVERSALS, {"used": 2, "needed": 6, "reasons": ["the sensor lost 3 samples"]}
)

finite = st.floats(allow_nan=False, allow_infinity=False)


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    value=finite,
    uncertainty=st.floats(0, allow_infinity=False),
    sensitivity=finite,
    residual=st.none() | finite,
    rejections=st.lists(
        st.builds(CalibrationRejection, st.just(RejectionCode.WRONG_DIRECTION), st.just({"ratio": -1.0}))
    ).map(tuple),
    when=st.datetimes(datetime(1971, 1, 1), datetime(2200, 1, 1)),
)
def test_written_result_is_read_again(tmp_path, value, uncertainty, sensitivity, residual, rejections, when):
    result = replace(
        RESULT,
        estimates={
            "scale": Estimate(value, (*scatter(1.0), Contribution("noise", "B", uncertainty, "°", sensitivity)), "1")
        },
        residual=residual,
        rejections=rejections,
        when_utc=when.replace(tzinfo=timezone(timedelta(hours=2))),
    )
    result.to_file(tmp_path / "result.json")
    assert [path.name for path in tmp_path.iterdir()] == ["result.json"]
    again = CalibrationResult.from_file(tmp_path / "result.json")
    assert again == result
    assert again.when_utc.utcoffset() == timedelta(0)
    assert again.passed is (not rejections)


@pytest.mark.parametrize(
    ("change", "mistake"),
    [
        ({"estimates": {"scale": {"value": "much", "budget": [], "unit": ""}}}, "estimates: scale: value"),
        (
            {"estimates": {"scale": {"value": 1, "budget": [{"kind": "C"}], "unit": ""}}},
            "estimates: scale: budget: 0: kind",
        ),
        (
            {"estimates": {"scale": {"value": 1, "budget": [{"uncertainty": -1}], "unit": ""}}},
            "estimates: scale: budget: 0: uncertainty: Input should be greater",
        ),
        ({"estimates": {}}, "needs an estimate"),
        ({"valid_days": -1}, "valid_days"),
        ({"when_utc": "2026-03-01T12:00:00"}, "when_utc"),
        ({"scale": 1.0}, "scale"),
        ({"rejections": None}, "rejections"),
    ],
)
def test_invalid_file_is_rejected_with_the_key(tmp_path, change, mistake):
    path = tmp_path / "result.json"
    RESULT.to_file(path)
    path.write_text(json.dumps({**json.loads(path.read_text(encoding="utf-8")), **change}), encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        CalibrationResult.from_file(path)
    assert mistake in " ".join(caught.value.evidence["mistakes"])


def test_missing_torn_and_unwritable_files_are_rejected(tmp_path):
    with pytest.raises(ConfigError, match=r"nowhere\.json"):
        CalibrationResult.from_file(tmp_path / "nowhere.json")
    (tmp_path / "torn.json").write_text('{"name": "imu.sc', encoding="utf-8")
    with pytest.raises(ConfigError):
        CalibrationResult.from_file(tmp_path / "torn.json")
    with pytest.raises(UsageError, match="Cannot write"):
        RESULT.to_file(tmp_path / "no-such-folder" / "result.json")


def test_result_needs_an_estimate_and_a_time_zone():
    with pytest.raises(ValueError, match="needs an estimate"):
        replace(RESULT, estimates={})
    with pytest.raises(ValueError, match="time zone"):
        replace(RESULT, when_utc=datetime(2026, 3, 1))
    with pytest.raises(ValueError, match="applies no settings"):
        replace(RESULT, rejections=(FEW,), settings={"imu.scale": 1.01})
    assert not replace(RESULT, estimates={}, rejections=(FEW,)).passed


NOW = datetime(2026, 3, 8, tzinfo=UTC)
HERE = {"bench": "sim", "imu": {"model": "MPU-6050", "axis": "z"}, "servo": {"id": 1}}


def test_newest_result_that_passed_on_these_devices_decides(tmp_path):
    store = CalibrationStore(tmp_path / "results")
    assert store.on_bench(HERE, NOW) == []
    days = [timedelta(days=n) for n in range(4)]
    elsewhere = {"bench": "sim", "imu": {"model": "BNO055"}}
    store.add(RESULT)
    store.add(replace(RESULT, when_utc=RESULT.when_utc + days[1]))
    store.add(replace(RESULT, when_utc=RESULT.when_utc + days[2], device=elsewhere))
    store.add(replace(RESULT, when_utc=RESULT.when_utc + days[3], rejections=(FEW,)))
    (calibration,) = store.on_bench(HERE, NOW)
    assert calibration.status is CalibrationStatus.IN_FORCE
    assert calibration.result.when_utc == RESULT.when_utc + days[1]
    assert [result.passed for result in store.history("imu.scale")] == [True, True, True, False]
    assert store.history("imu.bias") == []


@pytest.mark.parametrize(
    ("then", "now", "status"),
    [
        # The source has another name after replugging, or the name means another camera.
        (("camera 0", "USB A"), ("camera /dev/v4l/by-id/a", "USB A"), CalibrationStatus.IN_FORCE),
        (("camera 0", "USB A"), ("camera 0", "USB B"), CalibrationStatus.OTHER_DEVICE),
        # The device of one of them is not known.
        (("camera 0",), ("camera 0", "USB A"), CalibrationStatus.IN_FORCE),
        (("camera 0",), ("camera 1", "USB A"), CalibrationStatus.OTHER_DEVICE),
        (("film.mp4", None), ("film.mp4", None), CalibrationStatus.IN_FORCE),
        (("film.mp4", None), ("other.mp4", None), CalibrationStatus.OTHER_DEVICE),
    ],
)
def test_calibration_belongs_to_the_camera_and_not_to_its_source(tmp_path, then, now, status):
    camera = [dict(zip(("name", "device"), values, strict=False)) for values in (then, now)]
    store = CalibrationStore(tmp_path)
    store.add(replace(RESULT, name="camera.noise", device={"bench": "sim", "camera": {**camera[0], "width": 640}}))
    (calibration,) = store.on_bench({"bench": "sim", "camera": {**camera[1], "width": 640}}, NOW)
    assert calibration.status is status
    if "USB B" in now:
        assert calibration.changes == ("camera.device was USB A, is USB B",)


def test_age_other_device_and_failure_are_reported(tmp_path):
    store = CalibrationStore(tmp_path)
    store.add(replace(RESULT, name="a.old", valid_days=5))
    store.add(replace(RESULT, name="b.moved", device={"bench": "sim", "imu": {"model": "MPU-6050", "axis": "y"}}))
    store.add(replace(RESULT, name="c.failed", rejections=(FEW,)))
    old, moved, failed = store.on_bench(HERE, NOW)
    assert (old.status, old.repetition) == (CalibrationStatus.EXPIRED, Do.CALIBRATE(name="a"))
    assert "6 days ago; it is valid for 5 days" in str(old)
    assert moved.status is CalibrationStatus.OTHER_DEVICE
    assert "imu.axis was y, is z" in str(moved)
    assert failed.status is CalibrationStatus.FAILED
    assert str(FEW) in str(failed)


def test_torn_file_in_the_folder_is_reported_and_left_out(tmp_path):
    store = CalibrationStore(tmp_path)
    store.add(RESULT)
    (tmp_path / "00002-torn.json").write_text("{", encoding="utf-8")
    assert store.history() == [RESULT]
    assert "torn.json" in store.unreadable[0].what
    with pytest.raises(UsageError, match="Cannot store"):
        CalibrationStore(tmp_path / "00002-torn.json" / "results").add(RESULT)


def test_result_applies_only_settings_that_the_configuration_leaves_open():
    result = replace(RESULT, settings={"imu.scale": 1.01, "imu.scale_uncertainty": 1e-4})
    config, notes = apply_results(RigConfig(), [result])
    assert (config.imu.scale, config.imu.scale_uncertainty, notes) == (1.01, 1e-4, ())
    config, notes = apply_results(load_config(None, ["imu.scale=1.02"]), [result])
    assert (config.imu.scale, config.imu.scale_uncertainty) == (1.02, 1e-4)
    assert notes == (f"imu.scale = 1.02 of the configuration takes precedence over 1.01 of {result.id}",)
    region = replace(RESULT, settings={"view.roi": [0, 0, 100, 100]})
    assert apply_results(load_config(None, ["view.roi=none"]), [region])[0].view.roi is None
    with pytest.raises(ConfigError, match="calibrations in force"):
        apply_results(RigConfig(), [replace(RESULT, settings={"imu.scale": 7.0})])


@pytest.mark.parametrize("code", RejectionCode)
def test_every_rejection_has_words(code):
    class Values(dict):
        def __missing__(self, key):
            return 1

    assert code.value.format_map(Values())
    assert str(FEW) == "Only 2 reversals can be used, 6 are needed (the sensor lost 3 samples)."
    assert str(replace(FEW, values={**FEW.values, "reasons": []})) == "Only 2 reversals can be used, 6 are needed."


def test_uncertainty_is_the_root_of_the_sum_of_the_squared_contributions():
    noise = Contribution("noise", "B", 0.5, "mm", -8.0)
    estimate = Estimate(1.0, (*scatter(3.0, "°"), noise), "°")
    assert (noise.part, estimate.uncertainty) == (4.0, 5.0)
    assert [estimate.share(one) for one in estimate.budget] == pytest.approx([0.36, 0.64])
    assert estimate.expanded == "10°"  # twice the standard uncertainty
    nothing = Estimate(1.0, scatter(0.0), "°")
    assert (nothing.uncertainty, nothing.share(nothing.budget[0]), nothing.expanded) == (0.0, 0.0, "")
