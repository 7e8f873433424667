"""All errors of the simulated bench."""

from dataclasses import fields, replace
from typing import Annotated, Any, Self

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from sim.table import TABLE

Amount = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, lt=1)]
Axes = Amount | tuple[Amount, Amount, Amount]
"""One number for all axes of a sensor, or one for each."""


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid"))
class NoiseModel:
    """Errors of the simulated bench; defaults follow the datasheets of the parts.

    Values that differ from part to part (bias, scale, tilt) are drawn once per world from a normal distribution with
    the given standard deviation; the others act on every reading.
    """

    # Servo and table: XL430-W250 e-manual, measured backlash of its gears.
    backlash_deg: Amount = 0.25
    """Backlash between shaft and platter, full width."""
    servo_lag: Amount = 1.0
    """Lag of the shaft behind its motion profile, as a share of what the gains of its position controller give: 1 is a
    real servo."""
    servo_friction: Amount = 0.0254
    """Friction at rest, as a share of the stall torque. 0.0254 is a real XL430: asked for 1000 counts it stops at 995,
    asked for 1450 at 1446 (answers.ros.org 303081), and 885 / 5 counts push with the stall torque."""
    servo_friction_spread: Amount = 0.2
    """Standard deviation, from part to part, of the logarithm of that friction."""
    encoder_noise_deg: Amount = 0.02
    """Standard deviation of one encoder reading before its quantisation to 0.088°."""
    encoder_harmonic_deg: Amount = 0.0
    """Standard deviation, from part to part, of the encoder's error over a revolution: cosine and sine of its first two
    harmonics (the e-manual states no value; a magnet off the axis gives some tenths of a degree)."""
    structure_hz: Amount = TABLE["structure"]["frequency_hz"]
    """Natural frequency of platter and object on the shaft: they ring after each change of acceleration."""
    structure_damping: Share = TABLE["structure"]["damping"]
    """Damping ratio of that ringing, below 1."""
    speed_ripple: Amount = 0.015
    """Amplitude of the speed's ripple as a share of the speed. The e-manual states no ripple; the default is one unit
    of its velocity control, 0.229 rev/min, at 90 °/s. At rest there is no ripple."""
    voltage_noise_v: Amount = 0.05
    """Standard deviation of the supply voltage."""

    # Gyro and accelerometer: MPU-6000/6050 product specification rev 3.4, sections 6.1 and 6.2; gyro's noise: a real
    # one at rest (docs/explanation/simulator-against-recordings.md).
    gyro_noise_dps_rthz: Axes = (0.0075, 0.0055, 0.0056)
    """Rate noise density (specified: 0.005)."""
    gyro_flicker_dps: Axes = (0.004, 0.0009, 0.0007)
    """Flicker floor: the Allan deviation of the rate's 1/f noise, the same over all times from 1 to 1000 s."""
    gyro_bias_dps: Amount = 5.0
    """Standard deviation of the zero-rate output from part to part (specified within ±20 °/s)."""
    gyro_bias_walk_dps_rts: Amount = 0.0001
    """Random walk of the bias, per square root of a second."""
    gyro_bias_slope_dps_c: Amount = 0.02
    """Standard deviation of the zero rate's slope over temperature (specified: ±20 °/s between −40 and 85 °C)."""
    imu_warm_up_c: Amount = 5.0
    """Warming of the sensor above its surroundings after power-on."""
    gyro_scale_error: Amount = 0.01
    """Standard deviation of the relative scale error (specified within ±3 %)."""
    accel_noise_g_rthz: Amount = 0.0004
    """Acceleration noise density."""
    accel_bias_g: Amount = 0.03
    """Standard deviation of the zero-g output (specified within ±0.05 and ±0.08 g)."""
    imu_tilt_deg: Amount = 1.0
    """Standard deviation of the mounting tilt about each horizontal axis."""

    head_clock_error: Amount = 0.0015
    """Standard deviation of the relative error of a rig head's clock (a ceramic resonator: within ±0.5 %)."""

    # Camera: a 1/3" USB sensor at gain 1 (EMVA 1288 terms).
    full_well_e: Amount = 10000.0
    """Electrons of a saturated pixel, which determine the shot noise; 0: no shot noise."""
    read_noise_e: Amount = 12.0
    """Standard deviation of the dark noise in electrons."""
    vignetting: Share = 0.12
    """Relative loss of light in the image's corners."""
    light_flicker: Amount = 0.004
    """Standard deviation of the relative brightness from frame to frame."""

    gaussian_variance: Amount = 0.0
    """Variance of further white noise of intensities in 0..1, as the paper's GN has it (`hbr.drawing.noise`): 0.012, or
    0.000144 by the letter of the paper."""
    motion_px: Amount = 0.0
    """Length in pixels of a motion blur to 20°: the paper's MB has 15."""
    camera_readout_ms: Amount = 11.1
    """Time from the exposure of the first row to that of the last row (rolling shutter). OV5647: 640x480 at 90
    frames/s, so that a frame is read in at most 11.1 ms."""
    stamp_offset_ms: Amount = 8.0
    """Standard deviation, from camera to camera, of the time by which a frame is stamped after its exposure began. The
    V4L2 documentation expects a constant difference of up to a frame period, which is 33 ms at 30 frames/s."""
    stamp_jitter_ms: Amount = 0.2
    """Standard deviation of that time from frame to frame. The V4L2 documentation expects a few scan lines; a line of
    the OV5647 takes 0.023 ms, and the computer's interrupt adds its own."""
    lost_frames: Share = 0.01
    """Share of frames that never arrive: USB does not repeat a broken isochronous transfer (USB 2.0, 5.6.4). A Logitech
    046d:0991 on a Raspberry Pi lost 1 % on average (github.com/raspberrypi/linux/issues/238, 25 March 2013)."""
    usb_latency_ms: Amount = 2.0
    """Mean of the delay of a frame, distributed exponentially, in addition to a constant 15 ms. Linux (uvcvideo) waits
    until a transfer of 32 packets is full, one for each microframe of 0.125 ms: a frame ends 2 ms before that, on
    average."""

    camera_mount: Amount = 0.0
    """Error of the camera's position and direction: 1 means some millimetres and degrees (`sim.optics`)."""

    # The operator who places the objects.
    placement_mm: Amount = 1.0
    """Standard deviation of an object's distance from the axis, along each axis of the platter."""

    def __post_init__(self) -> None:
        if 0 < self.motion_px < 1:
            raise ValueError("motion_px: give a length of at least 1, or 0 for no blur")

    @classmethod
    def none(cls) -> Self:
        """Return a model without noise, backlash, errors and ringing."""
        zeros = dict.fromkeys((f.name for f in fields(cls)), 0.0)
        return cls(**zeros)

    def with_values(self, **values: Any) -> Self:
        """Return a copy with some values changed."""
        return replace(self, **values)
