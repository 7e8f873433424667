"""The findings of `rig doctor`: severity, text and fix of each in one table."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum, StrEnum, unique
from functools import partial
from typing import Any

from rig.core.errors import RigError
from rig.core.masking import masked
from rig.core.next_steps import Do, NextStep, NextSteps, SomeSteps, as_steps, in_words
from rig.core.phrases import filled
from rig.devices.i2c import RESTART_CONTROLLER


class Severity(StrEnum):
    """The severity of a finding: no problem, a possible problem, or a problem that prevents work."""

    FINE = "fine"
    WARNING = "warning"
    BAD = "bad"


def _row(level: Severity, text: str, *fix: str | NextStep) -> tuple[Any, ...]:
    return level, text, *fix


_fine, _warning, _bad = (partial(_row, level) for level in Severity)
_SET_TIME = "sudo timedatectl set-ntp true"
_RESTART_SENSOR = "Switch the sensor's supply off and on, and check SDA and SCL for a short circuit"


@unique
class FindingCode(Enum):
    """The table of all findings. The name of a member is its code in JSON.

    A row has the severity, the template of the text, and the fix. A code without a fix gets one when it is called, if
    its finding is not fine.
    """

    def __init__(self, level: Severity, text: str, *fix: str | NextStep) -> None:
        self.level, self.text, self.fix = level, text, fix

    def __call__(self, fix: SomeSteps = (), level: Severity | None = None, /, **parameters: Any) -> "Finding":
        """Return the finding with its parameters; a ``level`` or a ``fix`` replaces that of the row."""
        is_well = level is Severity.FINE and self.level is not level
        return Finding(level or self.level, self, parameters, () if is_well else as_steps(fix or self.fix))

    ERROR = _bad("{what}")
    CHECK_TIMED_OUT = _bad(
        "the check did not end within {deadline_s:g} s",
        "Unplug the device, plug it in again, and start over",
    )
    CHECK_INTERRUPTED = _bad("the check stopped: {reason}", Do.DOCTOR())
    CHECK_FAILED = _bad("the check has an error: {error}", Do.REPORT_DEFECT())
    NOT_CHECKED = _warning("not checked: the bench is in use", Do.STOP())
    # configuration, bench
    CONFIG_VALID = _fine("{path}: no mistakes")
    CONFIG_MISSING = _fine("no rig.toml: the defaults are used (rig setup writes a file)")
    CONFIG_MISTAKE = _bad("{what}: {mistake}", Do.CHECK_CONFIGURATION())
    BENCH_FREE = _fine("{bench}: free, no fault latched")
    BENCH_IN_USE = _warning("in use by {holder}: servo, IMU and camera are not checked", Do.STOP())
    STATE_DAMAGED = _bad(
        "damaged state: {what}",
        *("Check how far the cable is wound up, then", Do.ACKNOWLEDGE(), "If it hangs free,"),
        *(Do.SET_REVOLUTIONS(revolutions=0), "Otherwise, give the revolutions that it is wound up."),
    )
    FAULT_LATCHED = _bad("fault {code} ({title}) is latched since {utc}: {detail}", Do.ACKNOWLEDGE())
    # ports
    NO_SERIAL_PORT = _bad("there is no serial port {wanted} (found: {found})")
    NO_I2C_BUS = _bad("there is no I2C bus {wanted} (found: {found})")
    NO_CAMERA_DEVICE = _bad("there is no camera {wanted} (found: {found})")
    DEVICE_FILE = _fine("{path}: {name}")
    DEVICE_FILE_IN_USE = _bad("{path} is in use by {holders}")
    ROOT_ONLY = _bad("{user} has no permission for {path} ({name}): only root has access")
    MODEM_MANAGER = _warning("ModemManager runs, and sends modem commands to {path} when it is plugged in")
    BRLTTY_TAKES_PORT = _bad(
        "there is no serial port {wanted}, and brltty (process {pid}) takes USB adapters for itself"
    )
    GROUP_AT_NEXT_LOGIN = _bad(
        "{user} has no permission for {path} ({name}) before the next login: group {group} is new"
    )
    NOT_IN_GROUP = _bad("{user} has no permission for {path} ({name}): the group {group} has; log in again after this")
    LATENCY = _fine("latency timer of {path} is {latency_ms} ms")
    HIGH_LATENCY = _warning(
        "latency timer of {path} is {latency_ms} ms: each reading waits for it (permanently: {permanently})"
    )
    # disk, clock
    FREE_SPACE = _bad("{free_gb:.1f} GB free for {path}: about {objects} more objects", Do.REMOVE_DELETED())
    NOT_WRITABLE = _bad("{user} may not write to {path}")
    NETWORK_DISK = _warning(
        "{path} is on a network file system, where locks may fail",
        Do.SET_KEY(key="catalog.path", value="FOLDER-ON-A-LOCAL-DISK"),
    )
    WRONG_DATE = _bad("the date is wrong: {utc:%Y-%m-%d %H:%M} UTC: stored data would have a wrong date", _SET_TIME)
    NOT_SYNCHRONIZED = _warning(
        "{utc:%Y-%m-%d %H:%M} UTC, but no time server has been reached since this computer started",
        _SET_TIME,
    )
    NO_TIME_SERVER = _warning("{utc:%Y-%m-%d %H:%M} UTC, no time server that is known here", _SET_TIME)
    SYNCHRONIZED = _fine("{utc:%Y-%m-%d %H:%M} UTC, synchronised by a time server")
    # servo
    SUPPLY_SWITCHED = _warning(
        "not checked: the rig head's relay switches its supply on only while a program runs",
        Do.STATUS(),
    )
    SERVO = _fine("{model}, firmware {firmware}, id {id} at {baud} baud, {port}")
    NO_SERVO = _bad(
        "no servo answers at id {id}, {baud} baud, {port}, nor any other at any baud rate",
        "Check the servo's cable and switch on its 12 V supply (its LED blinks once), then",
        Do.DOCTOR(),
    )
    OTHER_SERVOS = _bad("no servo answers at id {id}, {baud} baud, {port} (found: {found})")
    ONLY_SERVO = _fine("the only servo on its bus")
    MORE_SERVOS = _fine("also on the bus, not checked: {found}")
    DUPLICATE_ID = _bad("{port}: two servos answer at once to id {ids} at {baud} baud (or the connection is very bad)")
    FOREIGN_BYTES = _warning(
        "{port}: bytes at {baud} baud that belong to no servo: another program or adapter, or a loose contact",
        "Remove everything but servos from the bus, then",
        Do.DOCTOR(),
    )
    SETTINGS_CORRECT = _fine("its permanent settings (EEPROM) are as required")
    SETTING_DIFFERS = _bad("EEPROM {difference}", Do.SERVO_SETTINGS())
    HARDWARE_ERROR = _bad(
        "reports a hardware error: {hardware_errors}; torque stays off until it restarts",
        Do.ACKNOWLEDGE(reboot=True),
    )
    WATCHDOG_TRIPPED = _warning("its watchdog tripped: a program ended during a rotation", Do.STATUS())
    TORQUE_ON = _warning("its torque is on although no program uses it", Do.STOP())
    IMPOSSIBLE_VALUES = _bad(
        "reports impossible values: {voltage_v:.1f} V and {temperature_c:.0f} °C",
        "Replace the servo, or its cable if another servo reports the same",
    )
    SUPPLY = _bad(
        "supply {voltage_v:.1f} V (the servo shuts down outside {low_v:.1f}–{high_v:.1f} V)",
        "Check the power supply and its plug",
    )
    TEMPERATURE = _bad(
        "temperature {temperature_c:.0f} °C (the servo shuts down above {limit_c:.0f} °C)",
        "Let it cool, and find out why the table is hard to rotate",
    )
    SERVO_FROZEN = _bad(
        "frozen: its own clock stood at {tick_ms} ms during {readings} readings: its readings are not valid",
        "Switch the servo's supply off and on, then",
        Do.DOCTOR(),
    )
    READINGS = _warning(
        "{readings} readings of {reading_ms:.1f} ms each, {retries} repeated",
        "Check the plugs of the servo's cable",
    )
    SLOW_READINGS = _warning("{readings} readings of {reading_ms:.1f} ms each, {retries} repeated: slow")
    # IMU
    IMU = _fine("{model} at {address:#04x} of {bus} (identity {who_am_i:#04x})")
    HEAD = _fine("{model} on a rig head ({board}, firmware {firmware}) at {port}")
    NO_IMU = _bad("no device answers at {address:#04x} of {bus} (at other IMU addresses: {found})")
    NO_DRIVER = _bad("{found}: the rig has no driver for it")
    OTHER_IMU = _bad("{found}, but imu.model is {model}")
    IMU_NOTE = _fine("{note}")
    I2C_NOT_OPENED = _bad("{bus} cannot be opened: {reason}", Do.FIND())
    I2C_STUCK = _bad("{bus} is stuck: {reason}; a device blocks the bus", _RESTART_SENSOR)
    I2C_HANGS = _bad(
        "the controller of {bus} hangs: {reason}; it works again after its supply was off",
        RESTART_CONTROLLER,
    )
    I2C_FAILED = _bad("{bus} fails at {address:#04x}: {reason}", _RESTART_SENSOR)
    KERNEL_DRIVER = _bad("the kernel driver {driver} uses {address:#04x} of {bus}")
    CLOCK_STRETCHING = _warning(
        "{bus} runs at {khz:g} kHz and does not wait for a BNO055, which stretches the clock",
        "echo dtparam=i2c_arm_baudrate=10000 | sudo tee -a /boot/firmware/config.txt && sudo reboot",
    )
    CORRUPT_READINGS = _warning("{corrupt} readings of the sensor were corrupt")
    SAMPLES_MISSING = _bad(
        "{samples} samples in {seconds:g} s instead of {wanted:.0f}, {lost} lost",
        "Shorten the I2C cable and remove other devices from the bus, then",
        Do.DOCTOR(),
    )
    AT_REST = _fine("at rest: noise {noise_dps:.3f} °/s, zero at {bias_dps:+.2f} °/s")
    SATURATED = _bad(
        "saturated at {range_dps:.0f} °/s at rest",
        "Check the sensor's supply and cable, then",
        Do.DOCTOR(),
    )
    IMU_FROZEN = _bad(
        "frozen: all samples are identical, without noise",
        "Switch the sensor's supply off and on, then",
        Do.DOCTOR(),
    )
    NOT_AT_REST = _bad(
        "noise {noise_dps:.3f} °/s, zero at {bias_dps:+.2f} °/s: more than a table at rest shows",
        "Check the sensor's supply, ground and cable, then",
        Do.DOCTOR(),
    )
    NOISY = _warning(
        "noise {noise_dps:.3f} °/s at rest; {expected_dps:.3f} °/s is usual",
        "Keep hands and vibration away from the bench, then",
        Do.DOCTOR(),
    )
    LARGE_BIAS = _bad("zero at {bias_dps:+.2f} °/s: outside the datasheet", "Replace the sensor")
    GRAVITY = _fine("gravity {size_g:.2f} g, {along:.0%} of it along {axis}")
    WRONG_GRAVITY = _bad("gravity is {size_g:.2f} g", "Check the sensor's supply, then", Do.DOCTOR())
    TILTED = _warning("its {axis} axis does not point along the table's axis: {along:+.2f} of gravity is along it")
    # camera
    CAMERA = _fine("{name}: {width}x{height} at {fps:.3g} frames/s")
    MODE_NOT_OFFERED = _warning("the camera does not offer {wanted}; nearest: {nearest}")
    TIME_BASE = _fine("frames timed by {time_base} exposure")
    SETTING_REJECTED = _warning("{setting}: requested {requested}, the camera reports {reported}")
    NOT_LOCKED = _warning("{settings} not locked: views of one object may differ")
    LOCKED = _fine("locked and read back: {settings}")
    BLACK = _bad(
        "black: mean level {mean_level:.1f} of 255",
        "Take the lens cap off and switch the light on, then",
        Do.DOCTOR(),
    )
    CAMERA_FROZEN = _bad(
        "frozen: {frames} frames are identical",
        "Unplug the camera, plug it in again, then",
        Do.DOCTOR(),
    )
    FRAMES = _fine("frames arrive {frame_age_ms:.0f} ms after exposure, {frames_per_s:.3g} a second")
    LATE_FRAMES = _warning(
        "frames arrive {frame_age_ms:.0f} ms after exposure, {frames_per_s:.3g} a second: too old",
        "Try another USB port, or reduce camera.width",
    )
    FEW_FRAMES = _warning(
        "frames arrive {frame_age_ms:.0f} ms after exposure, {frames_per_s:.3g} a second, not {fps:.3g}",
        "Try another USB port, or reduce camera.exposure_us or camera.fps",
    )
    MAINS_FLICKER = _warning(
        "the lamps flicker with the mains ({mains_hz:.0f} Hz): bands of {depth:.0%} in the images; an exposure "
        "of whole periods of the lamp has none"
    )
    STANDING_FLICKER_NOT_CHECKED = _fine(
        "bands of lamps at {mains_hz:.0f} Hz mains would stand still in the images, and are not checked; an "
        "exposure of whole periods of the lamp has none"
    )
    FLICKER = _warning(
        "the light changes by {spread:.0%} within {seconds:.0f} s",
        "Use a lamp that does not flicker, and keep daylight and shadows away, then",
        Do.DOCTOR(),
    )
    VIEW_ACCEPTED = _fine(
        "a view would be accepted now: mean level {mean_level:.0f}, sharpness {sharpness:.0f}, "
        "{saturated_share:.1%} saturated"
    )
    VIEW_REJECTED = _warning(
        "a view would be rejected now: {reasons}",
        "Check light, exposure and focus (an empty table may look blurred). The limits are in [view].",
        Do.SHOW_CONFIGURATION(),
    )
    # catalog, calibration
    NO_CATALOG = _fine("none yet in {path}; the first enrollment creates it")
    CATALOG = _fine("{path}: {objects} objects, {views} views; database undamaged, {images} images verified")
    DATABASE_DAMAGED = _bad("{path}: the database is damaged: {damage}", Do.VERIFY_CATALOG())
    IMAGES_DAMAGED = _bad("{broken} of {images} verified images are damaged: {first}", Do.VERIFY_CATALOG())
    UNFINISHED = _warning("unfinished enrollments: {objects}")
    CALIBRATION = _warning("{calibration}")
    NEVER_CALIBRATED = _warning("{name} was never calibrated: {consequence}")
    CAMERA_DELAY = _fine(
        "views wait {delay_ms:.0f} ms longer: by camera.time, exposures begin that long before their time stamp"
    )
    CAMERA_DELAY_UNKNOWN = _fine(
        "a delay inside the camera does not show in its time stamps; a calibration measures it (the table rotates)",
        Do.CALIBRATE(name="camera-time"),
    )
    # the scan of all devices
    NO_USB_PORT = _bad("no serial port on USB (found: {found})", "Connect the U2D2, then", Do.FIND())
    PORT_FAILED = _bad("{port} failed: {reason}", "Connect the adapter again, then", Do.FIND())
    NOTHING_ON_PORT = _warning(
        "{port} ({name}): no servo and no rig head answer at any baud rate",
        "Check the servo's cable and switch on its supply, then",
        Do.FIND(),
    )
    SERVO_FOUND = _fine("{port}: {found}")
    SERVO_NOT_DRIVEN = _warning("{port}: {found}: the rig cannot drive it: {reason}")
    IMU_FOUND = _fine("{found}")
    NO_I2C = _bad("no I2C bus")
    NO_IMU_FOUND = _warning(
        "no IMU answers on any I2C bus",
        "Check the sensor's 3.3 V, ground, SDA and SCL, then",
        Do.FIND(),
    )
    NO_CAMERA = _warning("no camera", "Connect the camera, then", Do.FIND())
    RIBBON_CAMERA = _fine("{name} on the ribbon cable: camera.source is picamera2:{number}")
    RIBBON_CAMERA_UNREACHABLE = _warning("{name} on the ribbon cable: {what}: {reason}")


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding about the bench."""

    level: Severity
    """Its severity."""
    code: FindingCode
    """What was found."""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    """The values in its text and other evidence, units in the keys."""
    steps: NextSteps = ()
    """What fixes the problem, as the next step of an error; empty if nothing does."""
    topic: str = ""
    """The checked part, for example ``servo``."""
    exit_code: int = 0
    """The exit code of `rig doctor` for this finding; 0 unless it is bad. Topic and exit code come from the check."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", masked(self.parameters))

    @property
    def fix(self) -> str:
        """What fixes the problem, as a terminal shows it."""
        return in_words(self.steps)

    @property
    def reported(self) -> "ReportedFinding":
        """The finding as `--json` and the server give it."""
        code, words, evidence = self.code.name.lower(), finding_words(self), _as_json(self.parameters)
        return ReportedFinding(self.topic, self.level, code, words, self.fix or None, self.steps, evidence)


@dataclass(frozen=True, slots=True)
class ReportedFinding:
    """A finding in words, with its ``evidence`` as JSON values."""

    topic: str
    level: Severity
    code: str
    finding: str
    fix: str | None
    steps: NextSteps
    evidence: dict[str, Any]


def graded(*, bad: bool, warning: bool = False) -> Severity:
    return Severity.BAD if bad else Severity.WARNING if warning else Severity.FINE


def of_error(error: RigError, fix: SomeSteps = ()) -> Finding:
    """Return an error as a finding; the parameter ``error_code`` is the code of the error."""
    reason = error.evidence.get("reason")
    what = f"{error.what.rstrip('.')}: {reason}" if reason else error.what
    parameters = {**error.evidence, "what": what, "error_code": error.code}
    return replace(FindingCode.ERROR(fix or error.steps, **parameters), exit_code=error.exit_code)


def finding_words(finding: Finding) -> str:
    """Return the text of a finding."""
    shown = {key: _listed(value) for key, value in finding.parameters.items()}
    return filled(finding.code.text, **shown)


def _listed(value: Any) -> Any:
    return ", ".join(map(str, value)) or "none" if isinstance(value, list | tuple) else "?" if value is None else value


def _as_json(value: Any) -> Any:
    """Return a value as JSON can have it; devices and dates as text."""
    if isinstance(value, list | tuple):
        return [_as_json(item) for item in value]
    if isinstance(value, Mapping):
        return {key: _as_json(item) for key, item in value.items()}
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)
