"""A calibrated fact on disk."""

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from calibration.fact import Fact
from rig.errors import ConfigError, UsageError

FACT = Fact(
    name="imu.scale",
    value=1.01,
    unit="1",
    uncertainty=1e-4,
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
        value=value,
        uncertainty=uncertainty,
        residual=residual,
        refusals=refusals,
        when_utc=when.replace(tzinfo=timezone(timedelta(hours=2))),
    )
    fact.to_file(tmp_path / "fact.json")
    again = Fact.from_file(tmp_path / "fact.json")
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
        ({"value": "much"}, "value"),
        ({"value": None}, "what passed has a value"),
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
        Fact.from_file(path)
    assert mistake in " ".join(caught.value.evidence["mistakes"])


def test_a_missing_a_torn_and_an_unwritable_file(tmp_path):
    with pytest.raises(ConfigError, match=r"nowhere\.json"):
        Fact.from_file(tmp_path / "nowhere.json")
    (tmp_path / "torn.json").write_text('{"name": "imu.sc', encoding="utf-8")
    with pytest.raises(ConfigError):
        Fact.from_file(tmp_path / "torn.json")
    with pytest.raises(UsageError, match="Cannot write"):
        FACT.to_file(tmp_path / "no-such-folder" / "fact.json")


def test_a_fact_cannot_pass_without_a_value_or_a_time_zone():
    with pytest.raises(ValueError, match="what passed"):
        replace(FACT, value=None)
    with pytest.raises(ValueError, match="time zone"):
        replace(FACT, when_utc=datetime(2026, 3, 1))
    assert not replace(FACT, value=None, uncertainty=None, refusals=("too few turns",)).passed
