"""Where the table stands after a pause: what the servo says, against what was written down."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hbr.core.angles import wrap180
from rig.config import TableConfig
from rig.devices.servo import ServoCondition, ServoIdentity
from rig.safety.angle_reference import AngleReference, check_saved_angle
from rig.safety.saved_state import SavedTable

IDENTITY = ServoIdentity("xl430_w250", 1060, 1, 46)
KEPT, LOST = (ServoCondition(False, False, False, lost, ()) for lost in (False, True))


def saved(position_deg: float, shift_deg: float = 0.0, path_deg: tuple[float, float] | None = None, **values: int):
    known = {"model_number": 1060, "bus_id": 1, "firmware": 46, **values}
    return SavedTable(position_deg=position_deg, shift_deg=shift_deg, path_deg=path_deg, **known)


@given(st.sampled_from([1, -1]), st.floats(-180, 540), st.floats(-720, 720), st.floats(-400, 400))
def test_servo_and_table_convert_both_ways(direction, zero_deg, shift_deg, table_deg):
    reference = AngleReference(TableConfig(direction=direction, zero_deg=zero_deg), shift_deg)
    assert reference.to_table(reference.to_servo(table_deg)) == pytest.approx(table_deg, abs=1e-9)


@given(st.sampled_from([1, -1]), st.floats(-720, 720), st.floats(-720, 720), st.integers(-3, 3))
def test_what_a_person_declares_holds(direction, position_deg, table_deg, turns):
    reference = AngleReference(TableConfig(direction=direction))
    before_deg = reference.to_table(position_deg)
    wound_deg = reference.with_turns(position_deg, turns)
    assert wrap180(wound_deg - before_deg) == pytest.approx(0, abs=1e-6)
    assert abs(wound_deg - 360 * turns) <= 180
    reference.declare(position_deg, table_deg)
    assert reference.to_table(position_deg) == pytest.approx(table_deg, abs=1e-9)


@given(st.floats(-4000, 4000), st.floats(-720, 720), st.sampled_from([360.0, 120.0, 72.0]))
def test_turns_that_were_lost_with_the_supply_are_restored_where_the_angle_fits(position_deg, shift_deg, turn_deg):
    found_deg = position_deg % turn_deg
    check = check_saved_angle(saved(position_deg, shift_deg), IDENTITY, found_deg, LOST, turn_deg)
    assert not check.doubt
    assert found_deg + check.shift_deg == pytest.approx(position_deg + shift_deg, abs=1e-6)
    assert bool(check.findings) == (abs(position_deg - found_deg) > turn_deg / 2)


@given(st.floats(-4000, 4000), st.floats(2.1, 357.9))
def test_a_table_that_was_turned_without_supply_is_in_doubt(position_deg, turned_deg):
    assert (
        "turned meanwhile"
        in check_saved_angle(saved(position_deg), IDENTITY, (position_deg + turned_deg) % 360, LOST).doubt
    )


@given(st.floats(-4000, 4000), st.floats(-175, 175))
def test_a_servo_with_supply_counts_what_a_hand_does(position_deg, turned_deg):
    check = check_saved_angle(saved(position_deg, 7.0), IDENTITY, position_deg + turned_deg, KEPT)
    assert (check.doubt, check.shift_deg) == ("", 7.0)
    assert bool(check.findings) == (abs(turned_deg) > 2)


@pytest.mark.parametrize("turns", [-2, -1, 1, 3])
def test_whole_turns_that_nobody_wrote_down_are_in_doubt(turns):
    assert check_saved_angle(saved(200.0), IDENTITY, 200.0 + 360 * turns, KEPT).doubt


def test_a_motion_that_was_cut_off_is_believed_on_its_way_and_with_its_supply_alone():
    cut = saved(180.0, path_deg=(180.0, 500.0))
    on_its_way = check_saved_angle(cut, IDENTITY, 430.0, KEPT)
    assert not on_its_way.doubt
    assert "cut off" in on_its_way.findings[0]
    assert not check_saved_angle(cut, IDENTITY, 504.0, KEPT).doubt  # a stop takes a little room
    assert "not on its way" in check_saved_angle(cut, IDENTITY, 506.0, KEPT).doubt
    assert "not on its way" in check_saved_angle(cut, IDENTITY, 174.0, KEPT).doubt
    # It would fit: 300° may be 300° or, a turn of them forgotten, no place on its way.
    assert "supply" in check_saved_angle(cut, IDENTITY, 300.0, LOST).doubt


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"model_number": 1020}, "another servo"),
        ({"bus_id": 2}, "another servo"),
        ({"firmware": 45}, "firmware was 45"),
    ],
)
def test_another_servo_is_in_doubt(values, words):
    assert words in check_saved_angle(saved(200.0, **values), IDENTITY, 200.0, KEPT).doubt


def test_a_bench_that_was_never_told_is_in_doubt():
    assert "nobody has told" in check_saved_angle(None, IDENTITY, 180.0, KEPT).doubt
