"""The sections of `rig.toml` for the table: how it moves, and when a motion is stopped."""

from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, field_validator

from rig.config.section import Section

MAX_LIMIT_DEG = 90_000.0
"""250 revolutions; extended position mode reaches 256 in each direction (e-manual, Operating Mode)."""

Degrees = Annotated[float, Field(allow_inf_nan=False)]
Harmonic = Annotated[float, Field(ge=-10, le=10)]


class TableConfig(Section):
    """The table: how it moves, and when it has settled."""

    mode: Literal["turntable", "pan"] = Field(
        "turntable",
        description="turntable: rotates beyond one revolution and counts revolutions; pan: stays within one revolution",
    )
    direction: Literal[1, -1] = Field(
        1, description="+1: a rising servo position rotates the table counter-clockwise, seen from above"
    )
    carries: Literal["object", "camera"] = Field(
        "object",
        description="what the servo rotates: the object in front of the camera, or the camera around the object",
    )
    zero_deg: float = Field(
        180.0,
        ge=-MAX_LIMIT_DEG,
        le=MAX_LIMIT_DEG,
        description="servo angle at home (table angle 0), on the table's side of the gear",
    )
    limits_deg: tuple[Degrees, Degrees] = Field(
        (-400.0, 400.0), description="cable budget: lowest and highest table angle"
    )
    velocity_dps: float = Field(90.0, ge=0.1, le=200, description="cruise speed; must be within the gyro's range")
    acceleration_dps2: float = Field(240.0, ge=0.1, le=5000, description="acceleration of the ramp")
    approach_deg: float = Field(
        3.0,
        ge=0,
        le=30,
        description="each stop is approached upwards from at least this far below, which takes up the gears' backlash",
    )
    # A position controller without an integral part stops where friction equals its push. An XL430 with factory gains
    # pushes with its stall torque at 15.6°; 2.5 % of that is a usual friction (0.4°), and 6.4 % are accepted.
    tolerance_deg: float = Field(
        1.0, ge=0.001, le=5, description="largest distance from the goal at which friction may hold an arrived table"
    )
    encoder_harmonics_deg: tuple[Harmonic, Harmonic, Harmonic, Harmonic] = Field(
        (0.0, 0.0, 0.0, 0.0),
        description="encoder error over a revolution: cosine and sine of the first and the second harmonic, from "
        "calibration",
    )
    backlash_deg: float = Field(
        0.5, ge=0, le=10, description="largest backlash between encoder and platter that is not a fault"
    )
    orientation: Literal["encoder", "imu"] = Field(
        "encoder", description="source of a view's angle: the servo's encoder, or only the gyro on the platter"
    )
    ringing_hz: float = Field(
        0.0,
        ge=0,
        le=200,
        description="frequency at which the platter rings after a stop, from calibration; moves then do not excite it; "
        "0: not known",
    )
    ringing_damping: float = Field(0.05, ge=0.001, le=0.9, description="damping ratio of that ringing")
    lag_s: float = Field(
        0.0, ge=0, le=0.3, description="time by which the shaft lags behind the profile, from that calibration"
    )
    held_deg: float = Field(
        0.0, ge=0, le=5, description="distance from its goal at which friction holds the shaft, from that calibration"
    )
    quiet_dps: float = Field(0.35, ge=0.001, le=10, description="largest rate that the gyro may measure at rest")
    # shorter: a platter that rings with 6 Hz is faster than quiet_dps only once in 0.083 s; longer: each view waits
    quiet_s: float = Field(0.1, ge=0.02, le=1, description="how long encoder and gyro must be quiet")
    poll_s: float = Field(0.04, ge=0.005, le=0.2, description="period of the control loop")
    watchdog_s: float = Field(
        0.5, ge=0.1, le=2.5, description="the servo stops by itself after this time without instructions"
    )

    @field_validator("limits_deg")
    @classmethod
    def _limits_hold_a_revolution(cls, limits_deg: tuple[float, float], others: ValidationInfo) -> tuple[float, float]:
        low, high = limits_deg
        pan = others.data.get("mode") == "pan"
        if pan and not (low <= 0 <= high and low < high):
            raise ValueError("must be the lowest and the highest angle and include 0, e.g. [-150, 150]")
        if not pan and not (low <= 0 <= high and high - low >= 360):
            raise ValueError('must span at least one revolution and include 0, e.g. [-400, 400], unless mode = "pan"')
        if max(-low, high) > MAX_LIMIT_DEG:
            raise ValueError(f"must be within ±{MAX_LIMIT_DEG:g}, the range of a servo in extended position mode")
        return limits_deg

    @field_validator("watchdog_s")
    @classmethod
    def _watchdog_outlasts_the_loop(cls, watchdog_s: float, others: ValidationInfo) -> float:
        poll_s = others.data.get("poll_s", 0.0)
        if watchdog_s < 2 * poll_s:
            raise ValueError(f"must be at least twice poll_s, which is {poll_s:g}: the control loop feeds the watchdog")
        return watchdog_s

    @property
    def orientation_sign(self) -> int:
        """Sign of the camera's azimuth around the object: −1 if the table angle θ rotates the object, else +1."""
        return 1 if self.carries == "camera" else -1


class MarkConfig(Section):
    """The home mark, from calibration: a card on the platter that shows the table's angle to the camera."""

    card: tuple[int, int, float, float] = Field(
        (0, 0, 0.0, 0.0), description="columns, rows, side of a square and of a marker in mm; no columns: there is none"
    )
    camera: tuple[float, float, float, float, float, float, float, float] = Field(
        (0.0,) * 8, description="fx, fy, cx, cy, k1, k2, p1 and p2 of the camera that saw it"
    )
    rotation: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="rotation vector of the card in the camera's frame at home"
    )
    axis: tuple[float, float, float] = Field((0.0, 0.0, 1.0), description="the table's axis in the camera's frame")


class SafetyConfig(Section):
    """When a motion is stopped: before the servo shuts down by itself, and long before something breaks."""

    # An XL430 with factory gains lags by 3.8° at 90 °/s, and by 8.5° at 200 °/s, the fastest table.
    following_error_deg: float = Field(
        12.0,
        ge=0.01,
        le=90,
        description="largest distance of the shaft from the servo's motion profile, and from its path",
    )
    max_load_percent: float = Field(
        70.0,
        ge=0.1,
        le=100,
        description="largest part of the servo's torque (or current limit) that is not an overload",
    )
    temperature_margin_c: float = Field(
        5.0, ge=0, le=40, description="distance from the temperature at which the servo shuts down"
    )
    voltage_margin_v: float = Field(
        0.2, ge=0, le=2, description="distance from the voltages at which the servo shuts down"
    )
    slip_deg: float = Field(
        10.0, ge=0.01, le=90, description="difference of encoder and gyro (beyond 4 sigma) that stops a motion"
    )
