"""A calibrated fact on disk."""

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rig.calibrations import CalibrationResult, CalibrationStore, Estimate, State, put_in_force
from rig.config import RigConfig, load_config
from rig.core.errors import ConfigError, UsageError

FACT = CalibrationResult(
    name="imu.scale",
    estimates={"scale": Estimate(1.01, 1e-4, "1")},
    residual=0.02,
    limit=0.1,
    residual_unit="°",
    refusals=(),
    when_utc=datetime(2026, 3, 1, 12, tzinfo=UTC),
    device={"bench": "sim", "imu": {"model": "MPU-6050"}},
    evidence={"legs": [{"encoder_deg": 360.0}]},
)

finite = st.floats(allow_nan=False, allow_infinity=False)


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    value=finite,
    uncertainty=finite,
    residual=st.none() | finite,
    refusals=st.lists(st.text(st.characters(codec="utf-8"))).map(tuple),
    when=st.datetimes(datetime(1971, 1, 1), datetime(2200, 1, 1)),
)
def test_what_is_written_is_read_again(tmp_path, value, uncertainty, residual, refusals, when):
    fact = replace(
        FACT,
        estimates={"scale": Estimate(value, uncertainty, "1")},
        residual=residual,
        refusals=refusals,
        when_utc=when.replace(tzinfo=timezone(timedelta(hours=2))),
    )
    fact.to_file(tmp_path / "fact.json")
    again = CalibrationResult.from_file(tmp_path / "fact.json")
    assert again == fact
    assert again.when_utc.utcoffset() == timedelta(0)
    assert again.passed is (not refusals)


def test_the_file_is_text_that_people_read(tmp_path):
    path = tmp_path / "fact.json"
    FACT.to_file(path)
    assert json.loads(path.read_text(encoding="utf-8"))["device"]["imu"] == {"model": "MPU-6050"}
    assert '  "residual_unit": "°",\n' in path.read_text(encoding="utf-8")
    assert [p.name for p in tmp_path.iterdir()] == ["fact.json"]


@pytest.mark.parametrize(
    ("change", "mistake"),
    [
        ({"estimates": {"scale": {"value": "much", "uncertainty": 1, "unit": ""}}}, "estimates: scale: value"),
        ({"estimates": {}}, "what passed has a value"),
        ({"valid_days": -1}, "valid_days"),
        ({"when_utc": "2026-03-01T12:00:00"}, "when_utc"),
        ({"scale": 1.0}, "scale"),
        ({"refusals": None}, "refusals"),
    ],
)
def test_a_file_that_is_no_fact_is_refused_with_the_key(tmp_path, change, mistake):
    path = tmp_path / "fact.json"
    FACT.to_file(path)
    path.write_text(json.dumps({**json.loads(path.read_text(encoding="utf-8")), **change}), encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        CalibrationResult.from_file(path)
    assert mistake in " ".join(caught.value.evidence["mistakes"])


def test_a_missing_a_torn_and_an_unwritable_file(tmp_path):
    with pytest.raises(ConfigError, match=r"nowhere\.json"):
        CalibrationResult.from_file(tmp_path / "nowhere.json")
    (tmp_path / "torn.json").write_text('{"name": "imu.sc', encoding="utf-8")
    with pytest.raises(ConfigError):
        CalibrationResult.from_file(tmp_path / "torn.json")
    with pytest.raises(UsageError, match="Cannot write"):
        FACT.to_file(tmp_path / "no-such-folder" / "fact.json")


def test_a_fact_cannot_pass_without_a_value_or_a_time_zone():
    with pytest.raises(ValueError, match="what passed"):
        replace(FACT, estimates={})
    with pytest.raises(ValueError, match="time zone"):
        replace(FACT, when_utc=datetime(2026, 3, 1))
    with pytest.raises(ValueError, match="nothing in force"):
        replace(FACT, refusals=("too few turns",), settings={"imu.scale": 1.01})
    assert not replace(FACT, estimates={}, refusals=("too few turns",)).passed


NOW = datetime(2026, 3, 8, tzinfo=UTC)
HERE = {"bench": "sim", "imu": {"model": "MPU-6050", "axis": "z"}, "servo": {"id": 1}}


def test_the_newest_fact_that_passed_on_these_devices_counts(tmp_path):
    store = CalibrationStore(tmp_path / "facts")
    assert store.standings(HERE, NOW) == []
    days = [timedelta(days=n) for n in range(4)]
    elsewhere = {"bench": "sim", "imu": {"model": "BNO055"}}
    store.keep(FACT)
    store.keep(replace(FACT, when_utc=FACT.when_utc + days[1]))
    store.keep(replace(FACT, when_utc=FACT.when_utc + days[2], device=elsewhere))
    store.keep(replace(FACT, when_utc=FACT.when_utc + days[3], refusals=("the platter slipped",)))
    (standing,) = store.standings(HERE, NOW)
    assert standing.state is State.IN_FORCE
    assert standing.fact.when_utc == FACT.when_utc + days[1]
    assert [fact.passed for fact in store.history("imu.scale")] == [True, True, True, False]
    assert store.history("imu.bias") == []


def test_age_another_device_and_failure_are_told(tmp_path):
    store = CalibrationStore(tmp_path)
    store.keep(replace(FACT, name="a.old", valid_days=5))
    store.keep(replace(FACT, name="b.moved", device={"bench": "sim", "imu": {"model": "MPU-6050", "axis": "y"}}))
    store.keep(replace(FACT, name="c.failed", refusals=("too few turns",)))
    old, moved, failed = store.standings(HERE, NOW)
    assert (old.state, old.command) == (State.EXPIRED, "rig calibrate a")
    assert "6 days ago; it holds for 5" in old.words
    assert moved.state is State.OTHER_DEVICE
    assert "imu.axis was y, is z" in moved.words
    assert failed.state is State.FAILED
    assert "too few turns" in failed.words


def test_a_torn_file_in_the_folder_is_told_and_left_out(tmp_path):
    store = CalibrationStore(tmp_path)
    store.keep(FACT)
    (tmp_path / "00002-torn.json").write_text("{", encoding="utf-8")
    assert store.history() == [FACT]
    assert "torn.json" in store.unreadable[0].what
    with pytest.raises(UsageError, match="Cannot keep"):
        CalibrationStore(tmp_path / "00002-torn.json" / "facts").keep(FACT)


def test_a_fact_sets_what_the_configuration_leaves_open():
    fact = replace(FACT, settings={"imu.scale": 1.01, "imu.scale_uncertainty": 1e-4})
    config, told = put_in_force(RigConfig(), [fact])
    assert (config.imu.scale, config.imu.scale_uncertainty, told) == (1.01, 1e-4, ())
    config, told = put_in_force(load_config(None, ["imu.scale=1.02"]), [fact])
    assert (config.imu.scale, config.imu.scale_uncertainty) == (1.02, 1e-4)
    assert told == (f"imu.scale = 1.02 of the configuration wins over 1.01, calibrated as {fact.id}",)
    with pytest.raises(ConfigError, match="calibrations in force"):
        put_in_force(RigConfig(), [replace(FACT, settings={"imu.scale": 7.0})])
