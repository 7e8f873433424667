"""The servo's motion control: from goal registers to trajectories, and the registers that report the motion."""

from enum import IntEnum
from math import cos, radians, sin

from sim.servo.control_table import Memory
from sim.servo.models import EXTENDED_POSITION_MODE, GAINS, POSITION_MODE, VELOCITY_MODE, ServoModel
from sim.servo.motor import Motor
from sim.world import World

# the e-manual calls these two thresholds of Moving Status predefined and states no values
IN_POSITION_DEG, FOLLOWING_ERROR_DEG = 0.36, 8.8
TICK_MODULUS_MS = 32_768


class Profile(IntEnum):
    """Profile Type of Moving Status."""

    STEP = 0
    RECTANGULAR = 1
    TRIANGULAR = 2
    TRAPEZOIDAL = 3


class Controller:
    """Converts the goal registers to trajectories of the motor.

    Position registers count the steps of the model's row from the encoder's zero. Whole revolutions are counted until
    `wrap_position`, as in the e-manual. Gains, PWM and current limits, Drive Mode and Homing Offset are stored but have
    no effect: before it moves a servo, the rig has set the last two.
    `harmonics_deg` is the encoder's error over a revolution: cosine and sine of the first and the second harmonic.
    """

    def __init__(self, world: World, memory: Memory, motor: Motor, model: ServoModel, center_counts: int) -> None:
        self._world = world
        self._memory = memory
        self._motor = motor
        self._model = model
        self._row = memory.row
        self._pwm_full = memory["PWM Limit"]
        self._center = center_counts
        self._rng = world.rng(f"servo-{memory['ID']}")
        part = world.rng(f"servo-{memory['ID']}-part")
        drawn = world.noise.encoder_harmonic_deg * part.standard_normal((2, 2))
        self.harmonics_deg = [(float(a), float(b)) for a, b in drawn]
        self._revolution_counts = 0
        self._profile = Profile.STEP
        self._started_ns = 0

    # -- commands -------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Start at power-up, with torque off and the initial values in RAM."""
        self._started_ns = self._world.clock.now_ns()
        self._profile = Profile.STEP
        self._memory["Goal PWM"] = self._memory["PWM Limit"]
        if "Goal Current" in self._memory:
            self._memory["Goal Current"] = self._memory["Current Limit"]
        self.wrap_position()

    def change_mode(self) -> None:
        """Reset the registers after a change of the Operating Mode (e-manual, Operating Mode and Present Position)."""
        for name in ("Profile Velocity", "Profile Acceleration", "Goal Velocity"):
            self._memory[name] = 0
        for name in GAINS:
            self._memory[name] = self._model.initial.get(name, 0)
        self._memory["Goal PWM"] = self._memory["PWM Limit"]
        if self._memory["Operating Mode"] in (POSITION_MODE, EXTENDED_POSITION_MODE):
            self.wrap_position()

    def torque_on(self) -> None:
        """Hold the shaft at its angle: a goal written while torque was off is ignored."""
        if self._memory["Operating Mode"] == POSITION_MODE:
            self.wrap_position()
        self._motor.hold()
        self._memory["Goal Position"] = self._present_position()
        self._memory["Goal Velocity"] = 0
        self._profile = Profile.STEP

    def stop(self) -> None:
        """Stop and hold, like a tripped Bus Watchdog; the goal register does not change."""
        self._memory["Profile Velocity"] = self._memory["Profile Acceleration"] = 0
        self._profile = Profile.STEP
        self._motor.brake()

    def pursue_position(self) -> None:
        """Plan the profile to Goal Position (e-manual, "What is the Profile"); other modes ignore it."""
        if self._memory["Operating Mode"] == VELOCITY_MODE:
            return
        goal_deg = self._degrees(self._memory["Goal Position"])
        velocity, acceleration = self._memory["Profile Velocity"], self._memory["Profile Acceleration"]
        v_max = min(self._motor.fastest_dps, self._memory["Velocity Limit"] * self._row.dps_per_unit)
        a_max = self._motor.steepest_dps2
        if velocity:
            v_max = min(v_max, velocity * self._row.dps_per_unit)
            a_max = min(a_max, acceleration * self._row.dps2_per_unit) if acceleration else a_max
        self._motor.go_to(goal_deg, max(v_max, _STANDSTILL), max(a_max, _STANDSTILL))
        if not velocity:
            self._profile = Profile.STEP
        elif not acceleration:
            self._profile = Profile.RECTANGULAR
        else:
            peak = float(abs(self._motor.commanded.velocity_dps).max())
            self._profile = Profile.TRAPEZOIDAL if peak >= v_max * (1 - 1e-9) else Profile.TRIANGULAR

    def pursue_velocity(self) -> None:
        """Ramp to Goal Velocity; other modes ignore it."""
        if self._memory["Operating Mode"] != VELOCITY_MODE:
            return
        fastest, a_max = self._motor.fastest_dps, self._motor.steepest_dps2
        goal_dps = min(max(self._memory["Goal Velocity"] * self._row.dps_per_unit, -fastest), fastest)
        acceleration = self._memory["Profile Acceleration"]
        a_max = min(a_max, acceleration * self._row.dps2_per_unit) if acceleration else a_max
        self._motor.rotate_at(goal_dps, max(a_max, _STANDSTILL))
        self._profile = Profile.TRAPEZOIDAL if acceleration else Profile.STEP

    def wrap_position(self) -> None:
        """Reset the count of revolutions: the position continues from within one revolution."""
        self._revolution_counts = 0
        positions = self._memory.one_revolution
        present = self._present_position() - positions.start
        self._revolution_counts = present - present % len(positions)
        self._memory["Goal Position"] = self._present_position()

    def slip_encoder(self, angle_deg: float) -> None:
        """Increase the encoder's reading by ``angle_deg``, and go to the goal by the new reading."""
        self._center += round(angle_deg / self._row.deg_per_count)
        if self._motor.driven:
            self.pursue_position()

    # -- reports --------------------------------------------------------------------------------------------------

    def refresh(self) -> None:
        """Update the registers that follow the world."""
        memory, motor, state = self._memory, self._motor, self._motor.state()
        present, target = self._present_position(), self._counts(state.target_deg)
        velocity = round(state.speed_dps / self._row.dps_per_unit)
        status = self._moving_status(present, target)
        noise_v = self._world.noise.voltage_noise_v
        voltage = motor.terminal_v(state.load) + (noise_v * self._rng.standard_normal() if noise_v else 0.0)
        elapsed_ms = (self._world.clock.now_ns() - self._started_ns) // 1_000_000
        memory["Realtime Tick"] = elapsed_ms % TICK_MODULUS_MS
        memory["Moving"] = int(bool(status & 0x02) or abs(velocity) > memory["Moving Threshold"])
        memory["Moving Status"] = status
        memory["Present PWM"] = round(state.pwm * self._pwm_full)
        if self._model.stall_current is None:
            memory["Present Load"] = round(state.load * 100 / self._row.load_percent_per_unit)
        else:
            memory["Present Current"] = round(state.load * self._model.stall_current)
        memory["Present Velocity"] = velocity
        memory["Present Position"] = present
        memory["Velocity Trajectory"] = round(state.target_dps / self._row.dps_per_unit)
        memory["Position Trajectory"] = target
        memory["Present Input Voltage"] = max(round(voltage / self._row.v_per_unit), 0)
        memory["Present Temperature"] = min(max(round(motor.temperature_c(state.load)), 0), 255)

    def _moving_status(self, present: int, target: int) -> int:
        if not self._memory["Torque Enable"]:
            return 0
        if self._memory["Operating Mode"] == VELOCITY_MODE:
            return self._profile << 4
        in_position = abs(self._memory["Goal Position"] - present) * self._row.deg_per_count < IN_POSITION_DEG
        ongoing = self._profile != Profile.STEP and self._motor.profile_ongoing
        following_error = abs(target - present) * self._row.deg_per_count > FOLLOWING_ERROR_DEG
        return self._profile << 4 | following_error << 3 | ongoing << 1 | in_position

    # -- scales ---------------------------------------------------------------------------------------------------

    def _counts(self, angle_deg: float) -> int:
        """Return the value of a position register at a shaft angle."""
        read_deg = angle_deg + self._encoder_error_deg(angle_deg)
        return round(read_deg / self._row.deg_per_count + self._center) - self._revolution_counts

    def _degrees(self, counts: int) -> float:
        """Return the shaft angle at which a position register reads ``counts``."""
        read_deg = (counts + self._revolution_counts - self._center) * self._row.deg_per_count
        angle_deg = read_deg
        for _ in range(3):  # the error changes by a hundredth of the angle at most
            angle_deg = read_deg - self._encoder_error_deg(angle_deg)
        return angle_deg

    def _encoder_error_deg(self, angle_deg: float) -> float:
        """Return the encoder's error at a shaft angle: its magnet is a little off the axis."""
        if not self._world.noise.encoder_harmonic_deg:
            return 0.0
        angle = radians(angle_deg)
        return sum(a * cos(n * angle) + b * sin(n * angle) for n, (a, b) in enumerate(self.harmonics_deg, start=1))

    def _present_position(self) -> int:
        # of an X series servo; the encoder of a P series servo is before its gear
        noise_deg = self._world.noise.encoder_noise_deg * min(self._row.deg_per_count / (360 / 4096), 1.0)
        error_deg = noise_deg * self._rng.standard_normal() if noise_deg else 0.0
        return self._counts(self._motor.rippled_deg() + error_deg)


_STANDSTILL = 1e-9  # smallest speed and acceleration of a profile: a profile of length 0 would have none
