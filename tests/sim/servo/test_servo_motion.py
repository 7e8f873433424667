"""The motion of the shaft and the registers during it, compared with the closed form of the profiles."""

from math import sqrt

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.noise import NoiseModel
from sim.servo.models import MODELS
from sim.servo.motor import FRICTION_LOAD
from tests.fuzzing import examples
from tests.sim.servo.servo_bench import DEG_PER_COUNT, DPS2_PER_UNIT, DPS_PER_UNIT, Line, extended

XL430 = MODELS["xl430_w250"]
IN_POSITION, ONGOING, FOLLOWING_ERROR = 0x01, 0x02, 0x08
TRIANGULAR, TRAPEZOIDAL, RECTANGULAR = 0x20, 0x30, 0x10


def duration(distance_deg: float, v: float, a: float) -> float:
    """Return the duration of a trapezoid or triangle from rest to rest."""
    return 2 * sqrt(distance_deg / a) if distance_deg * a <= v * v else distance_deg / v + v / a


def arrival_s(line: Line) -> float:
    """Return how long after the last instruction of the host the shaft comes to rest."""
    started_ns = [frame for frame in line.frames if frame.source.value == "host"][-1].end_ns
    return line.servos[1].motor.commanded.end_s - started_ns * 1e-9


@given(
    goal=st.integers(-20_000, 20_000).filter(lambda g: g != 2048),
    velocity=st.integers(1, 265),
    acceleration=st.integers(1, 139),
)
@examples(6)
def test_move_takes_the_profiles_time_and_ends_on_the_count(goal: int, velocity: int, acceleration: int) -> None:
    line = Line()
    line.add()
    extended(line, velocity, acceleration)
    line.put(Goal_Position=goal)
    v = velocity * DPS_PER_UNIT
    expected_s = duration(abs(goal - 2048) * DEG_PER_COUNT, v, acceleration * DPS2_PER_UNIT)
    assert arrival_s(line) == pytest.approx(expected_s, rel=1e-6, abs=1e-6)
    assert line.read("Moving Status") & (IN_POSITION | ONGOING) != IN_POSITION or expected_s < 0.01
    line.sleep(expected_s)
    assert line.read("Present Position") == goal
    assert line.shaft() == pytest.approx((goal - 2048) * DEG_PER_COUNT)
    assert (line.read("Moving"), line.read("Present Velocity")) == (0, 0)
    assert line.read("Moving Status") & 0x0F == IN_POSITION


def test_profile_velocity_0_means_maximum_speed(line: Line) -> None:
    line.put(Operating_Mode=4, Profile_Acceleration=1, Torque_Enable=1, Goal_Position=2048 + 4096)
    v = min(XL430.no_load_dps, 265 * DPS_PER_UNIT)
    assert arrival_s(line) == pytest.approx(duration(360, v, XL430.acceleration_dps2), rel=1e-6)
    assert line.read("Moving Status") & 0x30 == 0


def test_velocity_limit_and_supply_bound_the_speed(line: Line) -> None:
    line.put(Operating_Mode=4, Velocity_Limit=100, Torque_Enable=1, Goal_Position=100_000)
    line.sleep(1.0)
    assert line.read("Present Velocity") == 100
    line.put(Torque_Enable=0, Velocity_Limit=300)
    line.servos[1].set_voltage(6.0)
    line.put(Torque_Enable=1, Goal_Position=-100_000)
    line.sleep(1.0)
    assert line.read("Present Velocity") == round(-XL430.no_load_dps / 2 / DPS_PER_UNIT)


def test_goal_and_torque_written_again_during_a_move_change_nothing(line: Line) -> None:
    """A driver that repeats a write whose answer was lost must not disturb the motion."""
    extended(line)
    line.put(Goal_Position=6000)
    end_s = line.servos[1].motor.commanded.end_s
    for _ in range(50):
        line.sleep(0.03)
        line.put(Goal_Position=6000, Torque_Enable=1)
    assert line.servos[1].motor.commanded.end_s == pytest.approx(end_s, abs=1e-6)
    line.sleep(8.0)
    assert line.read("Present Position") == line.read("Goal Position") == 6000


def test_velocity_mode_ramps_and_keeps_rotating(line: Line) -> None:
    line.put(Operating_Mode=1, Profile_Acceleration=10, Torque_Enable=1, Goal_Velocity=-100)
    line.sleep(0.2)
    at_200_ms = line.read("Present Velocity")
    assert at_200_ms == pytest.approx(-0.2 * 10 * DPS2_PER_UNIT / DPS_PER_UNIT, abs=1)
    line.sleep(2.0)
    assert line.read("Present Velocity") == line.read("Velocity Trajectory") == -100
    before, start_ns = line.shaft(), line.clock.now_ns()
    line.sleep(10.0)
    rotated = -100 * DPS_PER_UNIT * (line.clock.now_ns() - start_ns) * 1e-9
    assert line.shaft() - before == pytest.approx(rotated)
    line.put(Goal_Velocity=0)
    line.sleep(2.0)
    assert line.servos[1].motor.busy is False


def test_new_goal_during_a_move_is_reached_without_a_jerk(line: Line) -> None:
    extended(line)
    line.put(Goal_Position=6000)
    line.sleep(1.0)
    line.put(Goal_Position=1000)
    assert line.read("Position Trajectory") == pytest.approx(line.read("Present Position"), abs=5)
    assert line.read("Velocity Trajectory") == pytest.approx(line.read("Present Velocity"), abs=3)
    for _ in range(60):
        earlier = line.worlds[1].shaft()
        line.sleep(0.05)
        later = line.worlds[1].shaft()
        assert abs(later[1] - earlier[1]) <= 10 * DPS2_PER_UNIT * 0.05 + 1e-6
    line.sleep(5.0)
    assert line.read("Present Position") == 1000


@pytest.mark.parametrize("velocity", [-60, 60])
def test_load_and_pwm_have_the_motions_sign(line: Line, velocity: int) -> None:
    sign = 1 if velocity > 0 else -1
    line.put(Operating_Mode=4, Profile_Velocity=abs(velocity), Torque_Enable=1, Goal_Position=sign * 100_000)
    line.sleep(1.0)
    assert line.read("Present Load") == sign * round(1000 * FRICTION_LOAD)
    assert line.read("Present PWM") == pytest.approx(885 * (velocity * DPS_PER_UNIT / 366 + sign * 0.04), abs=1)


def test_current_models_report_current() -> None:
    line = Line()
    line.add(1, "xm430_w350")
    line.put(Operating_Mode=4, Profile_Velocity=50, Torque_Enable=1, Goal_Position=100_000)
    line.sleep(1.0)
    assert line.read("Present Current") == round(855 * FRICTION_LOAD)


# -- position: revolutions, direction, offset -----------------------------------------------------------------------


def test_position_mode_loses_the_revolutions_when_torque_is_switched_on(line: Line) -> None:
    seconds = line.servos[1].rotate_by_hand(720.0 + 90.0)
    line.sleep(seconds)
    assert line.read("Present Position") == 2048 + 2 * 4096 + 1024
    line.put(Torque_Enable=1)
    assert line.read("Present Position") == 2048 + 1024


@given(rotations_deg=st.floats(-2000, 2000), center=st.integers(0, 4095))
@examples(6)
def test_power_up_reads_within_one_revolution(rotations_deg: float, center: int) -> None:
    line = Line()
    line.add(1, center_counts=center)
    line.put(Operating_Mode=4)
    line.sleep(line.servos[1].rotate_by_hand(rotations_deg))
    assert line.read("Present Position") == round(center + rotations_deg / DEG_PER_COUNT)
    line.servos[1].power_cycle()
    line.sleep(0.5)
    assert line.read("Present Position") == round(center + rotations_deg / DEG_PER_COUNT) % 4096


def test_encoder_noise_depends_on_noise_model_and_seed() -> None:
    def readings(sigma: float) -> list[int]:
        line = Line(noise=NoiseModel.none().with_values(encoder_noise_deg=sigma))
        line.add()
        return [line.read("Present Position") for _ in range(300)]

    noisy = readings(0.3)
    assert noisy == readings(0.3)
    spread = sqrt(sum((p - 2048) ** 2 for p in noisy) / len(noisy)) * DEG_PER_COUNT
    assert spread == pytest.approx(0.3, rel=0.2)
    assert set(readings(0.0)) == {2048}


# -- torque and modes -----------------------------------------------------------------------------------------------


def test_goal_written_while_torque_is_off_is_ignored(line: Line) -> None:
    line.put(Goal_Position=3000)
    assert line.read("Goal Position") == 3000
    line.sleep(1.0)
    line.put(Torque_Enable=1)
    line.sleep(1.0)
    assert line.shaft() == 0.0
    assert line.read("Goal Position") == 2048


def test_torque_holds_the_shaft_and_torque_off_releases_it(line: Line) -> None:
    extended(line, velocity=100)
    with pytest.raises(ValueError, match="torque"):
        line.servos[1].rotate_by_hand(10.0)
    line.put(Goal_Position=20_000)
    line.sleep(1.0)
    line.put(Torque_Enable=0)
    line.sleep(1.0)
    stopped = line.shaft()
    assert line.worlds[1].shaft()[1] == 0.0
    line.sleep(2.0)
    assert line.shaft() == stopped < 360.0
    assert line.read("Moving Status") == 0
