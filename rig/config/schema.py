"""The configuration `rig.toml`: all keys with unit, range and default."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

import platformdirs
from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from rig.config.catalog_place import CatalogPlace
from rig.config.imus import imu_kind
from rig.config.servos import driven
from rig.config.toml_file import NONE
from rig.config.values import APP, read_values, validate
from rig.config.wording import is_optional
from rig.core.masking import masked

MAX_LIMIT_DEG = 90_000.0
"""250 revolutions; extended position mode reaches 256 in each direction (e-manual, Operating Mode)."""

Degrees = Annotated[float, Field(allow_inf_nan=False)]
Harmonic = Annotated[float, Field(ge=-10, le=10)]
Fraction = Annotated[float, Field(ge=0, le=1)]
InCameraUnit = Annotated[float, Field(ge=0, le=1e6)]
Mode = Literal["auto", "step", "fly"]
"""Whether views are taken at rest (step) or while the table rotates (fly)."""


class Section(BaseModel):
    """Base of all sections: unknown keys are errors, and values cannot change.

    TOML has no null: the text ``"none"`` clears an optional key.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _read_none(cls, values: Any) -> Any:
        if not isinstance(values, Mapping):
            return values
        cleared = {key for key in values if values[key] == NONE and key in cls.model_fields}
        return {k: None if k in cleared and is_optional(cls.model_fields[k]) else v for k, v in values.items()}


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


class ViewConfig(Section):
    """Quality that a view needs."""

    roi: tuple[int, int, int, int] | None = Field(
        (80, 0, 480, 480),
        description="x, y, width and height of the image region that is described; none: the whole frame; the default "
        "follows the frame: the largest square in its middle",
    )
    min_sharpness: float = Field(
        3.0, ge=0, le=1e6, description="smallest variance of the Laplacian of the region in grey"
    )
    max_dark: Fraction = Field(0.95, description="largest part of pixels below level 8")
    max_saturated: Fraction = Field(0.25, description="largest part of pixels at level 255")
    min_mean: float = Field(4.0, ge=0, le=255, description="smallest mean level")
    max_noise: float = Field(  # half a frame of random bytes has more
        0.3,
        ge=0,
        le=10,
        description="largest share of noise in the differences of neighbouring pixels; 1 accepts even a frame of noise",
    )
    retakes: int = Field(3, ge=0, le=20, description="further frames before a view fails; repeated ones do not count")
    max_smear_px: float = Field(
        4.0,
        ge=0.1,
        le=100,
        description="largest motion during an exposure at the edge of the region, of views that are taken in motion",
    )
    max_angle_sigma_deg: float = Field(
        0.2, ge=0.01, le=10, description="largest standard uncertainty of the angle of a view that is taken in motion"
    )


class CatalogConfig(Section):
    """Where enrolled objects are stored."""

    path: Path | None = Field(
        None, description="folder of the catalog; none: one catalog for each bench in the user's data folder"
    )
    url: str | None = Field(
        None,
        description="PostgreSQL database of a catalog that several benches share: "
        "postgresql+psycopg://USER@HOST/DATABASE, with the password in ~/.pgpass; none: an SQLite file in the folder",
    )
    images: str | None = Field(
        None, description="folder or object store of the images, such as s3://BUCKET/FOLDER; none: the folder"
    )

    @field_validator("images")
    @classmethod
    def _shared_images(cls, images: str | None, others: ValidationInfo) -> str | None:
        if images is not None and others.data.get("url") is None:
            raise ValueError("is for a catalog with a url; an SQLite catalog has its images in its folder")
        return images


class EnrollConfig(Section):
    """How an object is enrolled."""

    views: int = Field(72, ge=4, le=720, description="views in a revolution")
    mode: Mode = Field(
        "auto",
        description="fly: the views are taken while the table rotates; step: at rest; auto: fly for trays if the "
        "camera's time is calibrated",
    )


class IdentifyConfig(Section):
    """How an object is identified."""

    strategy: Literal["dense", "arc", "ahbr", "hbr", "sweep", "random", "hmm"] | None = Field(
        None,
        description="strategy that chooses the next view; none: dense; ahbr is the paper's, hmm its successor",
    )
    mode: Mode = Field(
        "auto",
        description="fly: frames count while the table rotates; step: only at rest; auto: fly if the camera's time is "
        "calibrated (dense only)",
    )
    max_views: int = Field(8, ge=1, le=72, description="largest number of views")
    min_views: int = Field(
        2,
        ge=1,
        le=72,
        validate_default=True,
        description="smallest number of views before a decision; dense and hmm use their own rules instead",
    )
    first_step_deg: float = Field(
        90.0, ge=-180, le=180, description="rotation between the first two views; positive is counter-clockwise"
    )
    omega: float = Field(0.5, ge=0, le=100, description="weight of the orientation term")
    list_length: int = Field(10, ge=1, le=1000, description="views on a retrieval list")
    index: Literal["flat", "tree"] = Field(
        "flat", description="search for similar views: flat: compares all, tree: the paper's KD-tree; same answers"
    )
    extension: Literal["visual", "orient", "orient_all"] = Field(
        "orient_all", description="how missing views are filled in"
    )
    record: Literal["image", "answer", "none"] = Field(
        "image",
        description="what the catalog records of each answer: with the image of the first view, without, or nothing",
    )
    margin: Fraction = Field(
        0.02,
        description="stop when the best score is certain to lead by this margin for each view; not for dense and hmm",
    )
    repeatability: Fraction = Field(
        0.97, description="lowest similarity of the same view after placing the object again, from calibration"
    )
    min_score: Fraction | None = Field(
        None,
        description="an object with a lower score per view is unknown; none: from the enrolled views; not for dense",
    )

    @field_validator("min_views")
    @classmethod
    def _views_in_order(cls, min_views: int, others: ValidationInfo) -> int:
        max_views = others.data.get("max_views", min_views)
        if min_views > max_views:
            raise ValueError(f"must not be above max_views, which is {max_views}")
        return min_views


class ServeConfig(Section):
    """What the page of the bench shows of other benches."""

    benches: dict[str, str] = Field(
        default_factory=dict,
        description="benches of the page Benches: the address of the server of each, by name; a token stands before "
        "the host, as in token:TOKEN@left.local",
    )

    find: bool = Field(
        False, description="also show benches that announce themselves in the local network; needs hbr-rig[mdns]"
    )

    @field_validator("benches")
    @classmethod
    def _addresses(cls, benches: dict[str, str]) -> dict[str, str]:
        for name, address in benches.items():
            try:
                parts = urlsplit(address)
                is_server = parts.scheme in ("http", "https") and parts.hostname and parts.port != 0
                is_server = is_server and parts.path in ("", "/") and not (parts.query or parts.fragment)
            except ValueError:  # the port is no number
                is_server = False
            if not is_server:
                raise ValueError(f"{name} needs an address such as http://left.local:8420 (found {masked(address)!r})")
        return benches


class RigConfig(Section):
    """Everything in `rig.toml`."""

    default_bench: str = Field("hardware", description="bench that is opened without --bench")
    state_dir: Path | None = Field(
        None, description="folder of the benches' states, with one folder for each bench; none: the user's state folder"
    )
    calibration_dir: Path | None = Field(
        None, description="folder of the calibrations, with one folder for each bench; none: the user's data folder"
    )
    trace: Path | None = Field(
        None, description="new file that records what the bench exchanges with its devices; none: no recording"
    )
    notify_command: list[str] = Field(
        default_factory=list,
        description="program and its arguments, run with JSON on stdin when a job has ended or a fault was latched; "
        "no shell reads it",
    )
    servo: ServoConfig = ServoConfig()
    table: TableConfig = TableConfig()
    mark: MarkConfig = MarkConfig()
    safety: SafetyConfig = SafetyConfig()
    imu: ImuConfig = ImuConfig()
    head: HeadConfig = HeadConfig()
    camera: CameraConfig = CameraConfig()
    camera_time: CameraTimeConfig = CameraTimeConfig()
    view: ViewConfig = Field(ViewConfig(), validate_default=True)
    catalog: CatalogConfig = CatalogConfig()
    enroll: EnrollConfig = EnrollConfig()
    identify: IdentifyConfig = IdentifyConfig()
    serve: ServeConfig = ServeConfig()
    bench: dict[str, dict[str, Any]] = Field(
        default_factory=dict, description="options of each bench, by name: [bench.sim]"
    )

    @field_validator("view")
    @classmethod
    def _region_within_frame(cls, view: ViewConfig, others: ValidationInfo) -> ViewConfig:
        camera = others.data.get("camera")
        if camera is not None and "roi" not in view.model_fields_set:
            side = min(camera.width, camera.height)
            square = (camera.width - side) // 2, (camera.height - side) // 2, side, side
            # It stays unset, so that a calibration can set it.
            return ViewConfig.model_construct(view.model_fields_set, **{**dict(view), "roi": square})
        if camera is not None and view.roi is not None:
            x, y, width, height = view.roi
            if min(x, y) < 0 or min(width, height) < 1 or x + width > camera.width or y + height > camera.height:
                raise ValueError(
                    f"roi {list(view.roi)} is not within the camera's frame of {camera.width}x{camera.height}"
                )
        return view

    def with_max_views(self, max_views: int) -> "RigConfig":
        """Return this configuration with another largest number of views of a search; the smallest is not larger."""
        identify = self.identify
        limits = {"max_views": max_views, "min_views": min(identify.min_views, max_views)}
        return self.model_copy(update={"identify": identify.model_copy(update=limits)})

    def catalog_path(self, bench_name: str) -> Path:
        """Return the catalog's folder; by default each bench has its own: simulated and real views do not mix."""
        return self.catalog.path or Path(platformdirs.user_data_dir(APP)) / bench_name

    def catalog_place(self, bench_name: str) -> CatalogPlace:
        """Return where the catalog of the bench is."""
        return CatalogPlace(self.catalog_path(bench_name), self.catalog.url, self.catalog.images)

    def calibration_path(self, bench_name: str) -> Path:
        """Return the folder of the bench's calibrations."""
        return (self.calibration_dir or Path(platformdirs.user_data_dir(APP)) / "calibration") / bench_name

    def state_path(self, bench_name: str) -> Path:
        """Return the folder of the bench's state: revolutions, latched fault, and the program that uses it."""
        return (self.state_dir or Path(platformdirs.user_state_dir(APP))) / bench_name


def load_config(path: Path | None = None, overrides: Iterable[str] = (), *, search: bool = True) -> RigConfig:
    """Read a configuration file and apply ``overrides`` (``"section.key=value"``, values in TOML's notation).

    Without ``path`` it is the file in force, if any; with ``search`` false there is no file.

    Raises `ConfigError`: the file is missing, is not TOML, or has mistakes; the evidence lists all of them with their
    lines and keys.
    """
    read = read_values(path, overrides, search=search)
    where = str(read.path) if read.path else "the command line"
    return validate(RigConfig, read.values, where=where, lines=read.lines)
