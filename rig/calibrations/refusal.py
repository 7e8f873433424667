"""Why a calibration did not pass: a code with its numbers, and the words for people."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any


class RefusalCode(StrEnum):
    """A reason why a calibration does not pass: its code, and templates for the problem and the next step."""

    problem: str
    next_step: str

    def __new__(cls, code: str, problem: str, next_step: str = "") -> "RefusalCode":
        member = str.__new__(cls, code)
        member._value_ = code
        member.problem, member.next_step = problem, next_step
        return member

    # -- servo --
    TOO_FEW_REVERSALS = "too_few_reversals", "Only {used} reversals can be used, {needed} are needed{reasons}."
    TOO_FEW_STEPS = "too_few_steps", "Only {used} steps can be used, {needed} are needed{reasons}."
    LEG_SLIPPED = (
        "leg_slipped",
        "Leg {leg} deviates by {residual_deg:.2f}°, more than {limit_deg:.2f}°: the platter slipped or was touched.",
        "Tighten the platter, keep hands off, and calibrate again.",
    )
    WRONG_DIRECTION = (
        "wrong_direction",
        "The encoder and the gyro measure opposite directions (ratio {ratio:.3f}).",
        "Change the sign of table.direction, or of imu.sign if the sensor hangs upside down.",
    )
    WRONG_GEAR_RATIO = (
        "wrong_gear_ratio",
        "The table rotates {table_deg:.3f}° for each degree that the servo should rotate it.",
        "Multiply servo.gear_ratio by {ratio:.3g}, or look for a slipping belt.",
    )
    BACKLASH_TOO_LARGE = (
        "backlash_too_large",
        "The backlash is {backlash_deg:.2f}°, more than {limit_deg:g}°: the horn or a coupling is loose.",
        "Tighten it.",
    )
    BACKLASH_NEGATIVE = (
        "backlash_negative",
        "The measured backlash is negative ({backlash_deg:.2f}°): something pushes the platter.",
        "Look for a cable that pulls, and calibrate again.",
    )
    BACKLASH_UNCERTAIN = (
        "backlash_uncertain",
        "The uncertainty of the backlash is {uncertainty_deg:.3f}°, more than {limit_deg:g}°.",
        "Give more --reversals, and keep vibration off the bench.",
    )
    ENCODER_ERROR_TOO_LARGE = (
        "encoder_error_too_large",
        "The encoder seems wrong by up to {error_deg:.1f}°, more than {limit_deg:g}°, the limit for a sound one.",
        "Look for a platter that is loose on its shaft, or a sensor that shifts.",
    )
    ENCODER_UNCERTAIN = (
        "encoder_uncertain",
        "The uncertainty of the harmonics is {uncertainty_deg:.3f}°, more than {limit_deg:g}°.",
        "Give more --turns, and keep vibration off the bench.",
    )
    MOVE_HINDERED = (
        "move_hindered",
        "The rotation by {distance_deg:.0f}° took {seconds:.2f} s, {residual_s:.2f} s off the others: something "
        "hindered it, or shook the bench.",
        "Check the cable and the platter, and calibrate again.",
    )
    CABLE_ENDS_SWAPPED = (
        "cable_ends_swapped",
        "The counter-clockwise end ({high_deg:.0f}°) lies below the clockwise end ({low_deg:.0f}°): the ends were "
        "shown in the wrong order, or table.direction has the wrong sign.",
        "Check the direction with `rig calibrate servo`.",
    )
    CABLE_TOO_SHORT = (
        "cable_too_short",
        "Between the ends, less {margin_deg:g}° at each, the cable leaves {span_deg:.0f}°: less than one revolution.",
        'Give the cable more slack, lead it up along the axis, or set table.mode = "pan".',
    )
    HOME_OUTSIDE_CABLE = (
        "home_outside_cable",
        "Home (0°) does not lie between {low_deg:.0f}° and {high_deg:.0f}°.",
        "Rotate the table until the cable hangs free, run `rig home --here`, and show the ends again.",
    )
    # -- IMU --
    TOO_FEW_REVOLUTIONS = (
        "too_few_revolutions",
        "Only {up} revolutions upwards and {down} downwards can be used, {needed} in each direction are "
        "needed{reasons}.",
        "Give more --turns. If the rate is too high, lower table.velocity_dps or raise imu.range_dps.",
    )
    GYRO_IMPLAUSIBLE = (
        "gyro_implausible",
        "The gyro reads {ratio:.3f}° for each degree of the encoder: no sound part deviates so much.",
        "Check imu.axis, imu.sign and table.direction, that the sensor lies flat on the platter, and that no gear "
        "is between.",
    )
    DIRECTIONS_DIFFER = (
        "directions_differ",
        "The scale differs between the directions: {up:.5f} upwards, {down:.5f} downwards. The gyro's bias drifts, or "
        "the platter gives way.",
        "Let the sensor warm up for some minutes, tighten the platter, and calibrate again.",
    )
    SCALE_UNCERTAIN = (
        "scale_uncertain",
        "The uncertainty of the scale is {uncertainty:.2%}, more than {limit:.1%}: the gyro is noisy.",
        "Keep vibration off the bench, or give more --turns.",
    )
    TOO_FEW_RECORDED_MOVES = (
        "too_few_recorded_moves",
        "Only {used} of {planned} rotations can be used: the sensor lost samples.",
        "Close other programs, and calibrate again.",
    )
    TILT_TOO_LARGE = (
        "tilt_too_large",
        "The sensor is tilted by {tilt_deg:.1f}° against the table's axis, more than {limit_deg:g}°.",
        "Mount it flat on the platter.",
    )
    WRONG_AXIS = (
        "wrong_axis",
        "The table rotates about the sensor's {axis} axis.",
        'Set imu.axis = "{axis}" and imu.sign = {sign}.',
    )
    NOT_LEVEL = (
        "not_level",
        "The table's axis is {level_deg:.1f}° off the vertical, more than {limit_deg:g}°.",
        "Level the base. If it is level, check the accelerometer's range.",
    )
    GYRO_NOISY = (
        "gyro_noisy",
        "The angle random walk is {arw:.4f} °/√s, more than {limit:g} °/√s: the bench shakes, or the sensor is broken.",
        "Keep people and fans away from the bench, and calibrate again.",
    )
    RATE_JUMPED = (
        "rate_jumped",
        "After {at_s:.0f} s the rate jumped by {jump_dps:.3f} °/s: the table was touched or shaken.",
        "Keep hands off, and calibrate again.",
    )
    SAMPLES_LOST = (
        "samples_lost",
        "The sensor lost {lost} samples: another program used the bus, or the computer was busy.",
        "Close other programs, and calibrate again.",
    )
    TOO_FEW_MOVES = (
        "too_few_moves",
        "Too few {speed} rotations can be used, {needed} in each direction are needed{reasons}.",
        "Calibrate again.",
    )
    SCATTER_TOO_LARGE = (
        "scatter_too_large",
        "Rotations of {seconds:.1f} s scatter by {measured_deg:.3f}°, {ratio:.2f} times the stated "
        "{stated_deg:.3f}°: something shakes the bench, or the platter slips.",
        "Tighten the platter, keep hands and fans away, and calibrate again.",
    )
    SCATTER_TOO_SMALL = (
        "scatter_too_small",
        "Rotations of {seconds:.1f} s scatter by {measured_deg:.3f}°, {ratio:.2f} times the stated "
        "{stated_deg:.3f}°: the stated noise of the sensor is too large.",
        "Check that the right sensor is configured, and calibrate again.",
    )
    # -- camera --
    CONTRAST_TOO_LOW = (
        "contrast_too_low",
        "The scene spans {span:.0f} grey levels, {needed:g} are needed.",
        "Put something black and white in front of the camera, and lock an exposure that neither saturates nor "
        "darkens.",
    )
    NOISE_INDEPENDENT_OF_LIGHT = (
        "noise_independent_of_light",
        "The noise does not grow with the light: the camera processes the frames.",
        "Switch noise reduction off.",
    )
    NOT_SHARP = (
        "not_sharp",
        "The board's sharpness is {sharpness:.1f}, below {needed:g}.",
        "Focus the lens, and calibrate again.",
    )
    CARD_EXPOSURE = (
        "card_exposure",
        "The card's level is {level:.0f}: too dark or saturated.",
        "Change camera.exposure_us, and calibrate again.",
    )
    CARD_UNEVEN = (
        "card_uneven",
        "Parts of the frame deviate from the card's smooth shading by {residual:.0%}.",
        "Fill the frame with a plain card, and keep shadows off it.",
    )
    VIGNETTING_TOO_LARGE = (
        "vignetting_too_large",
        "The corners lose {loss:.0%} of the light: something covers the lens, or the zoom is at its end.",
        "Clear the lens or change the zoom, and calibrate again.",
    )
    CARD_BLACK = (
        "card_black",
        "The card, or one of its colours, is black.",
        "Take the cap off the lens, light the card, or raise camera.exposure_us.",
    )
    LOCKS_CHANGED = (
        "locks_changed",
        "The camera changed its settings: {before} became {after}.",
        "Lock them in [camera].",
    )
    LIGHT_DRIFTED = (
        "light_drifted",
        "The light drifted by {drift_percent:.1f} % in {minutes:.0f} minutes, more than {limit_percent:g} %.",
        "Let the lamps warm up, keep daylight out, and calibrate again.",
    )
    LIGHT_FLICKERS = (
        "light_flickers",
        "The light flickers by {flicker:.1%}, more than {limit:.0%}.",
        "Choose an exposure of whole periods of the mains (10 or 8.33 ms), or a lamp that does not flicker.",
    )
    COLOUR_CAST = (
        "colour_cast",
        "The card looks coloured: red is {red:.2f} and blue {blue:.2f} of green.",
        "Change camera.white_balance_k until both are near 1, or use a grey card.",
    )
    # -- board and table --
    FOREIGN_MARKERS = (
        "foreign_markers",
        "Markers were seen that are not on a board of {columns} columns and {rows} rows{markers}.",
        "Give the board's own --columns and --rows, or print it again with --print-board.",
    )
    WRONG_BOARD_LAYOUT = (
        "wrong_board_layout",
        "In {views} views markers were seen, but not where a board of {columns} columns and {rows} rows has them.",
        "Give the board's own --columns and --rows, or print it again with --print-board.",
    )
    TOO_FEW_VIEWS = (
        "too_few_views",
        "The board was found in {found} views over {span_deg:.0f}°, {needed} over {needed_deg:g}° are needed.",
        "Light and focus the board, keep it in the frame, and use the one that --print-board printed.",
    )
    BOARD_LOOSE = (
        "board_loose",
        "Between two views the board rotated by {difference_deg:.1f}° more or less than the table: it is loose, "
        "the table moves during the views, or servo.gear_ratio is wrong.",
        "Fix the board, and calibrate again.",
    )
    CORNERS_OFF = (
        "corners_off",
        "The corners deviate by {rms_px:.2f} px (RMS; view {view} by {view_px:.2f}), more than {limit_px:g} px: the "
        "frames are blurred, the board is not flat, or it moved.",
        "Focus the lens, glue the board to something stiff, and calibrate again.",
    )
    COVERAGE_TOO_SMALL = (
        "coverage_too_small",
        "Corners were seen in {covered:.0%} of the frame, {needed:.0%} are needed for the distortion.",
        "Bring the board nearer, or to the edges of the platter.",
    )
    FOCAL_LENGTH_UNCERTAIN = (
        "focal_length_uncertain",
        "The uncertainty of the focal length is {uncertainty:.1%}, more than {limit:.1%}.",
        "Lean the board back more in some of the positions.",
    )
    OBJECTS_CUT_OFF = (
        "objects_cut_off",
        "The frame cuts off objects of {radius_mm:g} mm radius and {height_mm:g} mm height: {left_px} px at the left, "
        "{top_px} px at the top, {right_px} px at the right, {bottom_px} px at the bottom.",
        "Aim the camera again or move it away, or give the size of your objects with --radius-mm and --height-mm. "
        "Check that the middle of the board is {board_mm:g} mm above the platter (--middle-mm).",
    )
    BOARD_SIZE_WRONG = (
        "board_size_wrong",
        "By the board the lens is {found_mm:.0f} mm from the axis, by --lens-mm {lens_mm:.0f} mm: its squares would "
        "be {true_square_mm:.1f} mm wide, not {square_mm:g} mm.",
        "Measure a square on the print and give --square-mm, or print the board true to scale.",
    )
    CIRCLES_OFF = (
        "circles_off",
        "The corners deviate from the circles by {rms_px:.2f} px (RMS), more than {limit_px:g} px: the board is "
        "loose, the table moved during the views, or the camera was touched since its calibration.",
        "Fix them, run `rig calibrate camera` if the lens was touched, and calibrate again.",
    )
    AXIS_UNCERTAIN = (
        "axis_uncertain",
        "The uncertainty of the axis is {uncertainty_px:.2f} px in the image, more than {limit_px:g} px.",
        "Bring the board nearer, or light it better.",
    )
    AXIS_WOBBLES = (
        "axis_wobbles",
        "The axis wobbles by {wobble_deg:.2f}°, more than {limit_deg:g}°.",
        "Check the bearing, and tighten the horn.",
    )
    # -- repeatability --
    TOO_FEW_PLACEMENTS = (
        "too_few_placements",
        "{placements} placements are too few for an error rate of {error_rate:.1%}: {needed} are needed.",
        "Give more --placements, or a larger --error-rate.",
    )
    SIMILARITY_TOO_LOW = (
        "similarity_too_low",
        "Views of the same azimuth have a similarity of only {similarity:.2f}, below {needed:g}: the object was not "
        "put back at its mark, or the light changed.",
        "Draw a mark on the platter, and calibrate again.",
    )
    LIGHT_DRIFTS_BETWEEN_PLACEMENTS = (
        "light_drifts_between_placements",
        "The first and the last placement are less similar than consecutive ones, by {drift:.3f}: the light drifts.",
        "Let the lamps warm up, lock the camera, and calibrate again.",
    )
    TEXT = "text", "{text}"
    """A result of version 1.x, which stored the words."""


@dataclass(frozen=True, slots=True)
class Refusal:
    """One reason why a calibration did not pass.

    Attributes
    ----------
    values
        The numbers that the words of ``code`` need, units in the keys.
    """

    code: RefusalCode
    values: dict[str, Any]

    def __str__(self) -> str:
        """Return the problem and the next step; lists are shown in parentheses, and left out if empty."""
        shown = {
            key: (f" ({'; '.join(map(str, value))})" if value else "") if isinstance(value, list | tuple) else value
            for key, value in self.values.items()
        }
        return " ".join(part.format_map(shown) for part in (self.code.problem, self.code.next_step) if part)


def stored_refusal(value: Any) -> Any:
    """Return a refusal as stored; version 1.x stored it as a sentence."""
    return {"code": RefusalCode.TEXT, "values": {"text": value}} if isinstance(value, str) else value


def refusal(code: RefusalCode, values: Mapping[str, Any]) -> Refusal:
    """Return a refusal whose values are plain Python numbers."""
    return Refusal(code, {key: value.item() if hasattr(value, "item") else value for key, value in values.items()})
