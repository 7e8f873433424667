"""The sections of `rig.toml` for the devices: servo, IMU, rig head and camera."""

from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, field_validator

from rig.config.imus import imu_kind
from rig.config.section import Section
from rig.config.servos import driven

InCameraUnit = Annotated[float, Field(ge=0, le=1e6)]


class ServoConfig(Section):
    """The servo: its connection and its model."""

    port: str = Field("/dev/ttyUSB0", description="serial port of the U2D2 or another adapter")
    baud: int = Field(57600, ge=9600, le=4_500_000, description="baud rate; the servo's factory setting is 57600")
    id: int = Field(1, ge=0, le=252, description="id on the bus")
    model: str = Field(
        "xl430_w250",
        description="model of the X, MX (2.0), P or PRO (A) series as in the SDK, or one of a plug-in; "
        "`rig find` names yours",
    )
    gear_ratio: float = Field(
        1.0,
        ge=0.001,
        le=1000,
        description="revolutions of the servo for one revolution of the table; table.direction sets the direction",
    )
    retries: int = Field(
        3, ge=0, le=20, description="repetitions of a failed transaction before the servo counts as silent"
    )
    write_settings: bool = Field(
        False, description="write EEPROM settings that differ from the ones that the rig needs"
    )

    @field_validator("model")
    @classmethod
    def _model_with_a_driver(cls, model: str) -> str:
        return driven(model)


class ImuConfig(Section):
    """The IMU: its connection and its mounting."""

    connection: Literal["i2c", "head"] = Field(
        "i2c", description="what the sensor is connected to: the computer's own I2C bus, or a rig head, see [head]"
    )
    model: str = Field(
        "mpu6050",
        description="sensor on the platter: mpu6050, mpu6500, mpu9250, mpu6050_clone, bno055, or one of a plug-in; "
        "`rig find` names yours",
    )
    bus: int | str = Field(1, description="I2C bus number, or the path of its device")
    address: int = Field(
        0x68,
        ge=0x08,
        le=0x77,
        validate_default=True,
        description="I2C address; an MPU has 0x68, or 0x69 with AD0 high; a BNO055 0x28, or 0x29 with ADR high",
    )
    axis: Literal["x", "y", "z"] = Field("z", description="the sensor's axis that is parallel to the table's axis")
    sign: Literal[1, -1] = Field(1, description="+1 if a counter-clockwise rotation reads positive")
    range_dps: Literal[250, 500, 1000, 2000] = Field(250, description="full scale of the gyro")
    rate_hz: float = Field(200.0, ge=4, le=1000, description="samples per second (MPU; a BNO055 has 100)")
    bandwidth_hz: Literal[188, 98, 42, 20, 10, 5] = Field(
        42, description="bandwidth of the MPU's low-pass filter; must be below half of rate_hz to avoid aliasing"
    )
    scale: float = Field(1.0, ge=0.8, le=1.25, description="true rate divided by measured rate, from calibration")
    scale_uncertainty: float = Field(
        0.012, ge=0, le=0.1, description="standard uncertainty of the scale; 0.012 without calibration"
    )

    @field_validator("model")
    @classmethod
    def _model_with_a_driver(cls, model: str) -> str:
        return imu_kind(model).key

    @field_validator("address")
    @classmethod
    def _address_of_the_model(cls, address: int, others: ValidationInfo) -> int:
        # The default is the MPU-6050's address, which other sensors cannot have.
        addresses = imu_kind(others.data["model"]).addresses if "model" in others.data else (address,)
        return addresses[0] if address == 0x68 and address not in addresses else address


class HeadConfig(Section):
    """The rig head: a small board that samples the IMU and keeps the bench safe (``imu.connection = "head"``)."""

    port: str = Field("/dev/ttyUSB1", description="serial port of the board")
    deadman_s: float = Field(
        0.25, ge=0.05, le=2, description="silence of this computer after which the head switches its outputs off"
    )
    light: float | None = Field(
        None,
        ge=0.001,
        le=1,
        description="duty cycle of the ring light while the bench is open; none: no light is connected to the head",
    )
    power: bool = Field(False, description="whether the servo's supply goes through the head's relay")


class CameraConfig(Section):
    """The camera and its locked settings."""

    source: int | str = Field(
        0,
        description="index or path of the camera, for OpenCV; picamera2 or picamera2:1: a camera on the ribbon cable "
        "of a Raspberry Pi",
    )
    width: int = Field(640, ge=80, le=8000, description="pixels")
    height: int = Field(480, ge=80, le=8000, description="pixels")
    fps: float = Field(30.0, ge=0.1, le=500, description="frames per second")
    fourcc: str | None = Field(
        None,
        pattern="^[A-Z0-9]{4}$",
        description="pixel format, e.g. YUYV or MJPG; none: an uncompressed one if the camera is fast enough with it, "
        "else MJPG",
    )
    exposure_us: float | None = Field(
        10_000.0,
        ge=1,
        le=1e6,
        description="locked exposure time; none keeps the camera's own. 10 ms is a period of lamps at 50 Hz mains; use "
        "8333 at 60 Hz",
    )
    gain: InCameraUnit | None = Field(
        0.0, description="locked gain in the camera's unit, at least its smallest; none keeps the camera's own"
    )
    white_balance_k: float | None = Field(
        5000.0, ge=1000, le=20000, description="locked white balance; none keeps the camera's own"
    )
    focus: InCameraUnit | None = Field(
        None,
        description="locked focus in the camera's unit; none: the autofocus finds it once, and the bench stores it",
    )
    sharpness: InCameraUnit | None = Field(
        None, description="sharpness in the camera's unit; none keeps the camera's own"
    )
    backlight_compensation: InCameraUnit | None = Field(
        None, description="backlight compensation in the camera's unit; none keeps the camera's own"
    )
    power_line_frequency: int | None = Field(
        None,
        ge=0,
        le=3,
        description="flicker filter: 0 off, 1 50 Hz, 2 60 Hz, 3 automatic; none keeps the camera's own",
    )


class CameraTimeConfig(Section):
    """When frames are exposed, from `rig calibrate camera-time`."""

    offset_ms: float | None = Field(
        None,
        ge=-1000,
        le=1000,
        description="time from a frame's time stamp to the middle of its exposure in the middle row; none: not "
        "calibrated, and no view is taken in motion",
    )
    uncertainty_ms: float = Field(0.2, ge=0, le=100, description="standard uncertainty of this time")
    jitter_ms: float = Field(0.5, ge=0, le=100, description="standard deviation of this time from frame to frame")
    readout_ms: float = Field(0.0, ge=0, le=1000, description="time from the first to the last row (rolling shutter)")
