"""The table's angle after a pause: the servo's position compared with the stored one."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hbr.core.angles import wrap180
from rig.config import TableConfig
from rig.devices.servo import ServoCondition, ServoIdentity
from rig.safety.angle_reference import AngleFinding, AngleReference, check_saved_angle
from rig.safety.saved_state import SavedTable

IDENTITY = ServoIdentity("xl430_w250", 1060, 1, 46)
KEPT, LOST = (ServoCondition(False, False, False, lost, ()) for lost in (False, True))


def saved(position_deg: float, shift_deg: float = 0.0, path_deg: tuple[float, float] | None = None, **values: int):
    known = {"model_number": 1060, "bus_id": 1, "firmware": 46, **values}
    known |= {"zero_deg": 0, "direction": 1, "gear_ratio": 1}
    return SavedTable(position_deg=position_deg, shift_deg=shift_deg, path_deg=path_deg, **known)


@given(st.sampled_from([1, -1]), st.floats(-180, 540), st.floats(-720, 720), st.floats(-400, 400))
def test_servo_and_table_convert_both_ways(direction, zero_deg, shift_deg, table_deg):
    reference = AngleReference(TableConfig(direction=direction, zero_deg=zero_deg), shift_deg)
    assert reference.to_table(reference.to_servo(table_deg)) == pytest.approx(table_deg, abs=1e-9)


@given(st.sampled_from([1, -1]), st.floats(-720, 720), st.floats(-720, 720), st.integers(-3, 3))
def test_set_angle_sets_the_table_angle_at_a_position(direction, position_deg, table_deg, revolutions):
    reference = AngleReference(TableConfig(direction=direction))
    before_deg = reference.to_table(position_deg)
    wound_deg = reference.with_revolutions(position_deg, revolutions)
    assert wrap180(wound_deg - before_deg) == pytest.approx(0, abs=1e-6)
    assert abs(wound_deg - 360 * revolutions) <= 180
    reference.set_angle(position_deg, table_deg)
    assert reference.to_table(position_deg) == pytest.approx(table_deg, abs=1e-9)


@given(st.floats(-4000, 4000), st.floats(-720, 720), st.sampled_from([360.0, 120.0, 72.0]))
def test_revolutions_lost_with_the_supply_are_restored_if_the_angle_matches(position_deg, shift_deg, revolution_deg):
    found_deg = position_deg % revolution_deg
    check = check_saved_angle(saved(position_deg, shift_deg), IDENTITY, found_deg, LOST, revolution_deg)
    assert check.certain
    assert found_deg + check.shift_deg == pytest.approx(position_deg + shift_deg, abs=1e-6)
    restored = check.finding is AngleFinding.REVOLUTIONS_RESTORED
    assert restored == (abs(position_deg - found_deg) > revolution_deg / 2)
    assert restored or check.finding is AngleFinding.UNCHANGED


@given(st.floats(-4000, 4000), st.floats(2.1, 357.9))
def test_rotation_without_supply_makes_the_angle_uncertain(position_deg, rotated_deg):
    check = check_saved_angle(saved(position_deg), IDENTITY, (position_deg + rotated_deg) % 360, LOST)
    assert check.finding is AngleFinding.ROTATED_WITHOUT_POWER
    assert not check.certain


@given(st.floats(-4000, 4000), st.floats(-175, 175))
def test_servo_with_supply_counts_rotation_by_hand(position_deg, rotated_deg):
    check = check_saved_angle(saved(position_deg, 7.0), IDENTITY, position_deg + rotated_deg, KEPT)
    by_hand = abs(rotated_deg) > 2
    assert check.finding is (AngleFinding.ROTATED_BY_HAND if by_hand else AngleFinding.UNCHANGED)
    assert check.shift_deg == 7.0


@pytest.mark.parametrize("revolutions", [-2, -1, 1, 3])
def test_unrecorded_revolutions_make_the_angle_uncertain(revolutions):
    check = check_saved_angle(saved(200.0), IDENTITY, 200.0 + 360 * revolutions, KEPT)
    assert check.finding is AngleFinding.POSITION_CHANGED
    assert not check.certain


@pytest.mark.parametrize(
    ("position_deg", "condition", "finding"),
    [
        (430.0, KEPT, AngleFinding.MOTION_INTERRUPTED),
        (504.0, KEPT, AngleFinding.MOTION_INTERRUPTED),  # a stop needs a little room
        (506.0, KEPT, AngleFinding.NOT_ON_PATH),
        (174.0, KEPT, AngleFinding.NOT_ON_PATH),
        # 300° would fit, but it may also be a revolution that the servo lost.
        (300.0, LOST, AngleFinding.POWER_LOST_IN_MOTION),
    ],
)
def test_interrupted_motion_is_certain_on_its_path_with_supply_only(position_deg, condition, finding):
    check = check_saved_angle(saved(180.0, path_deg=(180.0, 500.0)), IDENTITY, position_deg, condition)
    assert check.finding is finding
    assert check.certain == (finding is AngleFinding.MOTION_INTERRUPTED)


@pytest.mark.parametrize(
    ("values", "finding"),
    [
        ({"model_number": 1020}, AngleFinding.OTHER_SERVO),
        ({"bus_id": 2}, AngleFinding.OTHER_SERVO),
        ({"firmware": 45}, AngleFinding.OTHER_FIRMWARE),
        (None, AngleFinding.NEVER_REFERENCED),
    ],
)
def test_another_servo_or_a_new_bench_makes_the_angle_uncertain(values, finding):
    check = check_saved_angle(None if values is None else saved(200.0, **values), IDENTITY, 200.0, KEPT)
    assert check.finding is finding
    assert not check.certain


@pytest.mark.parametrize("finding", AngleFinding)
def test_each_finding_has_a_text(finding):
    check = check_saved_angle(saved(200.0, firmware=45), IDENTITY, 210.0, KEPT)
    assert str(check) == "the servo's firmware changed from 45 to 46"
    assert str(replace(check, finding=finding))
