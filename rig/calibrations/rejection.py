"""Reasons why a calibration did not pass: a code with its numbers, and its text for the operator."""

from dataclasses import dataclass
from enum import Enum, unique
from typing import Annotated, Any

from pydantic import BeforeValidator, PlainSerializer

from rig.core.phrases import filled


@unique
class RejectionCode(Enum):
    """A reason why a calibration does not pass: the name is its code, the value its text and the next step."""

    # -- servo --
    TOO_FEW_REVERSALS = "Only {used} reversals can be used, {needed} are needed{reasons}."
    TOO_FEW_STEPS = "Only {used} steps can be used, {needed} are needed{reasons}."
    LEG_SLIPPED = (
        "Leg {leg} deviates by {residual_deg:.2f}°, more than {limit_deg:.2f}°: the platter slipped or was touched. "
        "Tighten the platter, keep hands off, and calibrate again."
    )
    WRONG_DIRECTION = (
        "The encoder and the gyro measure opposite directions (ratio {ratio:.3f}). Change the sign of table.direction,"
        " or of imu.sign if the sensor hangs upside down."
    )
    WRONG_GEAR_RATIO = (
        "The table rotates {table_deg:.3f}° for each degree that the servo should rotate it. Multiply servo.gear_ratio"
        " by {ratio:.3g}, or look for a slipping belt."
    )
    BACKLASH_TOO_LARGE = (
        "The backlash is {backlash_deg:.2f}°, more than {limit_deg:g}°: the horn or a coupling is loose. Tighten it."
    )
    BACKLASH_NEGATIVE = (
        "The measured backlash is negative ({backlash_deg:.2f}°): something pushes the platter. Look for a cable that "
        "pulls, and calibrate again."
    )
    BACKLASH_UNCERTAIN = (
        "The uncertainty of the backlash is {uncertainty_deg:.3f}°, more than {limit_deg:g}°. Give more reversals, "
        "and keep vibration off the bench."
    )
    ENCODER_ERROR_TOO_LARGE = (
        "The encoder seems wrong by up to {error_deg:.1f}°, more than {limit_deg:g}°, the limit for an undamaged one. "
        "Look for a platter that is loose on its shaft, or a sensor that shifts."
    )
    ENCODER_UNCERTAIN = (
        "The uncertainty of the harmonics is {uncertainty_deg:.3f}°, more than {limit_deg:g}°. Give more "
        "revolutions, and keep vibration off the bench."
    )
    MOVE_HINDERED = (
        "The rotation by {distance_deg:.0f}° took {seconds:.2f} s, {residual_s:.2f} s off the others: something "
        "hindered it, or shook the bench. Check the cable and the platter, and calibrate again."
    )
    NO_RINGING = (
        "After a stop the platter moves by {peak_dps:.2f} °/s at most, and the gyro's noise is {noise_dps:.2f} °/s: it "
        "does not ring, and its moves need no other profile."
    )
    RINGING_UNCLEAR = (
        "The rate after a stop differs from one decaying oscillation by {residual:.1f} times the noise: keep hands and "
        "other machines off the bench. If the object on the table rocks, fasten it."
    )
    RINGING_UNCERTAIN = (
        "The platter rings at {hz:.1f} Hz with an uncertainty of {uncertainty_hz:.2f} Hz, more than "
        "{limit_hz:.2f} Hz. Give more stops."
    )
    CABLE_ENDS_SWAPPED = (
        "The counter-clockwise end ({high_deg:.0f}°) lies below the clockwise end ({low_deg:.0f}°): the ends were "
        "shown in the wrong order, or table.direction has the wrong sign. Check the direction with the "
        "calibration of the servo."
    )
    CABLE_TOO_SHORT = (
        "Between the ends, less {margin_deg:g}° at each, the cable leaves {span_deg:.0f}°: less than one revolution. "
        'Give the cable more slack, lead it up along the axis, or set table.mode = "pan".'
    )
    HOME_OUTSIDE_CABLE = (
        "Home (0°) does not lie between {low_deg:.0f}° and {high_deg:.0f}°. Rotate the table until the cable hangs "
        "free, make that angle home, and show the ends again."
    )
    # -- IMU --
    TOO_FEW_REVOLUTIONS = (
        "Only {up} revolutions upwards and {down} downwards can be used, {needed} in each direction are "
        "needed{reasons}. Give more revolutions. If the rate is too high, lower table.velocity_dps or raise "
        "imu.range_dps."
    )
    GYRO_IMPLAUSIBLE = (
        "The gyro reads {ratio:.3f}° for each degree of the encoder: no undamaged part deviates so much. Check "
        "imu.axis, imu.sign and table.direction, that the sensor lies flat on the platter, and that no gear is between."
    )
    DIRECTIONS_DIFFER = (
        "The scale differs between the directions: {up:.5f} upwards, {down:.5f} downwards. The gyro's bias drifts, or "
        "the platter gives way. Let the sensor warm up for some minutes, tighten the platter, and calibrate again."
    )
    SCALE_UNCERTAIN = (
        "The uncertainty of the scale is {uncertainty:.2%}, more than {limit:.1%}: the gyro is noisy. Keep vibration "
        "off the bench, or give more revolutions."
    )
    TOO_FEW_RECORDED_MOVES = (
        "Only {used} of {planned} rotations can be used: the sensor lost samples. Close other programs, and calibrate "
        "again."
    )
    TILT_TOO_LARGE = (
        "The sensor is tilted by {tilt_deg:.1f}° against the table's axis, more than {limit_deg:g}°. Mount it flat on "
        "the platter."
    )
    WRONG_AXIS = 'The table rotates about axis {axis} of the sensor. Set imu.axis = "{axis}" and imu.sign = {sign}.'
    NOT_LEVEL = (
        "The table's axis is {level_deg:.1f}° off the vertical, more than {limit_deg:g}°. Level the base. If it is "
        "level, check the accelerometer's range."
    )
    TOO_FEW_MOVES = (
        "Too few {speed} rotations can be used, {needed} in each direction are needed{reasons}. Calibrate again."
    )
    SCATTER_TOO_LARGE = (
        "Rotations of {seconds:.1f} s scatter by {measured_deg:.3f}°, {ratio:.2f} times the stated {stated_deg:.3f}°: "
        "something shakes the bench, or the platter slips. Tighten the platter, keep hands and fans away, and "
        "calibrate again."
    )
    SCATTER_TOO_SMALL = (
        "Rotations of {seconds:.1f} s scatter by {measured_deg:.3f}°, {ratio:.2f} times the stated {stated_deg:.3f}°: "
        "the stated noise of the sensor is too large. Check that the right sensor is configured, and calibrate again."
    )
    # -- camera --
    EXPOSURE_NOT_LOCKED = (
        "The exposure time is not locked, so the middle of an exposure changes. Set camera.exposure_us to a number."
    )
    STAMPS_UNUSABLE = (
        "The camera's time stamps cannot be used: they repeat, go backwards, or are not of the computer's clock. Take "
        "views at rest (enroll.mode = step), or use a camera whose driver stamps frames."
    )
    TOO_FEW_FRAMES = (
        "Only {used} frames in motion can be used, {needed} are needed. Put an object with texture on the table, and "
        "light it better."
    )
    TOO_LITTLE_TEXTURE = (
        "The frames determine the angle only to {uncertainty_deg:.2f}°, {needed_deg:g}° is needed. Put an object with "
        "more texture on the table, or the board."
    )
    FRAME_TIME_UNCERTAIN = (
        "The uncertainty of the time is {uncertainty_ms:.2f} ms, more than {limit_ms:g} ms. Put an object with more "
        "texture on the table, and calibrate again."
    )
    FRAME_JITTER_TOO_LARGE = (
        "The time of the frames jitters by {jitter_ms:.2f} ms: at {speed_dps:.0f} °/s this is {jitter_deg:.2f}°, more "
        "than {limit_deg:g}°. Close other programs, connect the camera without a hub, or lower table.velocity_dps."
    )
    FRAMES_LOST = (
        "{lost:.0%} of the frames were lost, more than {limit:.0%}. Connect the camera to another USB port, without a "
        "hub."
    )
    PLATTER_SLIPPED = (
        "Encoder and gyro differ by {residual_deg:.2f}° during a revolution: the platter slipped. Tighten the platter, "
        "and calibrate again."
    )
    # -- board and table --
    FOREIGN_MARKERS = (
        "Markers were seen that are not on a board of {columns} columns and {rows} rows{markers}. Give the board's own"
        " columns and rows, or print it again."
    )
    WRONG_BOARD_LAYOUT = (
        "In {views} views markers were seen, but not where a board of {columns} columns and {rows} rows has them. Give"
        " the board's own columns and rows, or print it again."
    )
    TOO_FEW_VIEWS = (
        "The board was found in {found} views over {span_deg:.0f}°, {needed} over {needed_deg:g}° are needed. Light "
        "and focus the board, keep it in the frame, and use a board that this program printed."
    )
    BOARD_LOOSE = (
        "Between two views the board rotated by {difference_deg:.1f}° more or less than the table: it is loose, the "
        "table moves during the views, or servo.gear_ratio is wrong. Fix the board, and calibrate again."
    )
    CORNERS_OFF = (
        "The corners deviate by {rms_px:.2f} px (RMS; view {view} by {view_px:.2f}), more than {limit_px:g} px: the "
        "frames are blurred, the board is not flat, or it moved. Focus the lens, glue the board to something stiff, "
        "and calibrate again."
    )
    COVERAGE_TOO_SMALL = (
        "Corners were seen in {covered:.0%} of the frame, {needed:.0%} are needed for the distortion. Bring the board "
        "nearer, or to the edges of the platter."
    )
    FOCAL_LENGTH_UNCERTAIN = (
        "The uncertainty of the focal length is {uncertainty:.1%}, more than {limit:.1%}. Lean the board back more in "
        "some of the positions."
    )
    OBJECTS_CUT_OFF = (
        "The frame cuts off objects of {radius_mm:g} mm radius and {height_mm:g} mm height: {left_px} px at the left, "
        "{top_px} px at the top, {right_px} px at the right, {bottom_px} px at the bottom. Aim the camera again or "
        "move it away, or give the radius and the height of your objects. Check that the middle of the"
        " board is {board_mm:g} mm above the platter."
    )
    BOARD_SIZE_WRONG = (
        "By the board the lens is {found_mm:.0f} mm from the axis, by the given distance {lens_mm:.0f} mm: its squares "
        "would be {true_square_mm:.1f} mm wide, not {square_mm:g} mm. Measure a square on the print and give its "
        "width, or print the board true to scale."
    )
    CIRCLES_OFF = (
        "The corners deviate from the circles by {rms_px:.2f} px (RMS), more than {limit_px:g} px: the board is loose,"
        " the table moved during the views, or the camera was touched since its calibration. Fix them, calibrate "
        "the camera if the lens was touched, and calibrate again."
    )
    AXIS_UNCERTAIN = (
        "The uncertainty of the axis is {uncertainty_px:.2f} px in the image, more than {limit_px:g} px. Bring the "
        "board nearer, or light it better."
    )
    AXIS_WOBBLES = (
        "The axis wobbles by {wobble_deg:.2f}°, more than {limit_deg:g}°. Check the bearing, and tighten the horn."
    )
    # -- repeatability --
    TOO_FEW_PLACEMENTS = (
        "{placements} placements are too few for an error rate of {error_rate:.1%}: {needed} are needed. Give more "
        "placements, or a larger error rate."
    )
    SIMILARITY_TOO_LOW = (
        "Views of the same azimuth have a similarity of only {similarity:.2f}, below {needed:g}: the object was not "
        "put back at its mark, or the light changed. Draw a mark on the platter, and calibrate again."
    )
    LIGHT_DRIFTS_BETWEEN_PLACEMENTS = (
        "The first and the last placement are less similar than consecutive ones, by {drift:.3f}: the light drifts. "
        "Let the lamps warm up, lock the camera, and calibrate again."
    )


def _known(code: RejectionCode | str) -> RejectionCode:
    return code if isinstance(code, RejectionCode) else RejectionCode[code.upper()]


@dataclass(frozen=True, slots=True)
class CalibrationRejection:
    """One reason why a calibration did not pass.

    ``values`` are the numbers that the words of ``code`` need, units in the keys.
    """

    code: Annotated[RejectionCode, BeforeValidator(_known), PlainSerializer(lambda code: code.name.lower())]
    values: dict[str, Any]

    def __str__(self) -> str:
        """Return the problem and the next step; lists are shown in parentheses, and left out if empty."""
        shown = {
            key: (f" ({'; '.join(map(str, value))})" if value else "") if isinstance(value, list | tuple) else value
            for key, value in self.values.items()
        }
        return filled(self.code.value, **shown)
