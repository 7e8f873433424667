"""A finding of `rig doctor`: a code with parameters, and the fix for a problem."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum, StrEnum, unique
from typing import Any

from rig.core.errors import RigError
from rig.core.masking import masked
from rig.core.next_steps import NextSteps, SomeSteps, as_steps, in_words, steps_as_json
from rig.core.phrases import filled


class Severity(StrEnum):
    """The severity of a finding: no problem, a possible problem, or a problem that prevents work."""

    FINE = "fine"
    WARNING = "warning"
    BAD = "bad"


MARKS = {Severity.FINE: "✓", Severity.WARNING: "!", Severity.BAD: "✗"}


@unique
class FindingCode(Enum):
    """The codes of all findings. The name of a member is its code in JSON, its value the template of its text."""

    ERROR = "{what}"
    CHECK_TIMED_OUT = "the check did not end within {deadline_s:g} s"
    CHECK_INTERRUPTED = "the check stopped: {reason}"
    CHECK_FAILED = "the check has an error: {error}"
    NOT_CHECKED = "not checked: the bench is in use"
    # configuration, bench
    CONFIG_VALID = "{path}: no mistakes"
    CONFIG_MISSING = "no rig.toml: the defaults are used (rig setup writes a file)"
    CONFIG_MISTAKE = "{what}: {mistake}"
    BENCH_FREE = "{bench}: free, no fault latched"
    BENCH_IN_USE = "in use by {holder}: servo, IMU and camera are not checked"
    STATE_DAMAGED = "damaged state: {what}"
    FAULT_LATCHED = "fault {code} ({title}) is latched since {utc}: {what}"
    # ports
    NO_SERIAL_PORT = "there is no serial port {wanted} (found: {found})"
    NO_I2C_BUS = "there is no I2C bus {wanted} (found: {found})"
    NO_CAMERA_DEVICE = "there is no camera {wanted} (found: {found})"
    DEVICE_FILE = "{path}: {name}"
    DEVICE_FILE_IN_USE = "{path} is in use by {holders}"
    ROOT_ONLY = "{user} has no permission for {path} ({name}): only root has access"
    MODEM_MANAGER = "ModemManager runs, and sends modem commands to {path} when it is plugged in"
    BRLTTY_TAKES_PORT = "there is no serial port {wanted}, and brltty (process {pid}) takes USB adapters for itself"
    GROUP_AT_NEXT_LOGIN = "{user} has no permission for {path} ({name}) before the next login: group {group} is new"
    NOT_IN_GROUP = "{user} has no permission for {path} ({name}): the group {group} has; log in again after this"
    LATENCY = "latency timer of {path} is {latency_ms} ms"
    HIGH_LATENCY = "latency timer of {path} is {latency_ms} ms: each reading waits for it (permanently: {permanently})"
    # disk, clock
    FREE_SPACE = "{free_gb:.1f} GB free for {path}: about {objects} more objects"
    NOT_WRITABLE = "{user} may not write to {path}"
    NETWORK_DISK = "{path} is on a network file system, where locks may fail"
    WRONG_DATE = "the date is wrong: {utc:%Y-%m-%d %H:%M} UTC: stored data would have a wrong date"
    NOT_SYNCHRONIZED = "{utc:%Y-%m-%d %H:%M} UTC, but no time server has been reached since this computer started"
    NO_TIME_SERVER = "{utc:%Y-%m-%d %H:%M} UTC, no time server that is known here"
    SYNCHRONIZED = "{utc:%Y-%m-%d %H:%M} UTC, synchronised by a time server"
    # servo
    SUPPLY_SWITCHED = "not checked: the rig head's relay switches its supply on only while a program runs"
    SERVO = "{model}, firmware {firmware}, id {id} at {baud} baud, {port}"
    NO_SERVO = "no servo answers at id {id}, {baud} baud, {port}, nor any other at any baud rate"
    OTHER_SERVOS = "no servo answers at id {id}, {baud} baud, {port} (found: {found})"
    ONLY_SERVO = "the only servo on its bus"
    MORE_SERVOS = "also on the bus, not checked: {found}"
    DUPLICATE_ID = "{port}: two servos answer at once to id {ids} at {baud} baud (or the connection is very bad)"
    FOREIGN_BYTES = (
        "{port}: bytes at {baud} baud that do not belong to a servo: another program or adapter on the bus, or a loose "
        "contact"
    )
    SETTINGS_CORRECT = "its permanent settings (EEPROM) are as required"
    SETTING_DIFFERS = "EEPROM {difference}"
    HARDWARE_ERROR = "reports a hardware error: {hardware_errors}; torque stays off until it restarts"
    WATCHDOG_TRIPPED = "its watchdog tripped: a program ended during a rotation"
    TORQUE_ON = "its torque is on although no program uses it"
    IMPOSSIBLE_VALUES = "reports impossible values: {voltage_v:.1f} V and {temperature_c:.0f} °C"
    SUPPLY = "supply {voltage_v:.1f} V (the servo shuts down outside {low_v:.1f}–{high_v:.1f} V)"
    TEMPERATURE = "temperature {temperature_c:.0f} °C (the servo shuts down above {limit_c:.0f} °C)"
    SERVO_FROZEN = "frozen: its own clock stood at {tick_ms} ms during {readings} readings: its readings are not valid"
    READINGS = "{readings} readings of {reading_ms:.1f} ms each, {retries} repeated"
    SLOW_READINGS = "{readings} readings of {reading_ms:.1f} ms each, {retries} repeated: slow"
    # IMU
    IMU = "{model} at {address:#04x} of {bus} (identity {who_am_i:#04x})"
    HEAD = "{model} on a rig head ({board}, firmware {firmware}) at {port}"
    NO_IMU = "no device answers at {address:#04x} of {bus} (at other IMU addresses: {found})"
    NO_DRIVER = "{found}: the rig has no driver for it"
    OTHER_IMU = "{found}, but imu.model is {model}"
    IMU_NOTE = "{note}"
    I2C_NOT_OPENED = "{bus} cannot be opened: {reason}"
    I2C_STUCK = "{bus} is stuck: {reason}; a device blocks the bus"
    I2C_HANGS = "the controller of {bus} hangs: {reason}; it works again after its supply was off"
    I2C_FAILED = "{bus} fails at {address:#04x}: {reason}"
    KERNEL_DRIVER = "the kernel driver {driver} uses {address:#04x} of {bus}"
    CLOCK_STRETCHING = "{bus} runs at {khz:g} kHz and does not wait for a BNO055, which stretches the clock"
    CORRUPT_READINGS = "{corrupt} readings of the sensor were corrupt"
    SAMPLES_MISSING = "{samples} samples in {seconds:g} s instead of {wanted:.0f}, {lost} lost"
    AT_REST = "at rest: noise {noise_dps:.3f} °/s, zero at {bias_dps:+.2f} °/s"
    SATURATED = "saturated at {range_dps:.0f} °/s at rest"
    IMU_FROZEN = "frozen: all samples are identical, without noise"
    NOT_AT_REST = "noise {noise_dps:.3f} °/s, zero at {bias_dps:+.2f} °/s: more than a table at rest shows"
    NOISY = "noise {noise_dps:.3f} °/s at rest; {expected_dps:.3f} °/s is usual"
    LARGE_BIAS = "zero at {bias_dps:+.2f} °/s: outside the datasheet"
    GRAVITY = "gravity {size_g:.2f} g, {along:.0%} of it along {axis}"
    WRONG_GRAVITY = "gravity is {size_g:.2f} g"
    TILTED = "its {axis} axis does not point along the table's axis: {along:+.2f} of gravity is along it"
    # camera
    CAMERA = "{name}: {width}x{height} at {fps:.3g} frames/s"
    MODE_NOT_OFFERED = "the camera does not offer {wanted}; nearest: {nearest}"
    TIME_BASE = "frames timed by {time_base} exposure"
    SETTING_REJECTED = "{setting}: requested {requested}, the camera reports {reported}"
    NOT_LOCKED = "{settings} not locked: views of one object may differ"
    LOCKED = "locked and read back: {settings}"
    BLACK = "black: mean level {mean_level:.1f} of 255"
    CAMERA_FROZEN = "frozen: {frames} frames are identical"
    FRAMES = "frames arrive {frame_age_ms:.0f} ms after exposure, {frames_per_s:.3g} a second"
    LATE_FRAMES = "frames arrive {frame_age_ms:.0f} ms after exposure, {frames_per_s:.3g} a second: too old"
    FEW_FRAMES = "frames arrive {frame_age_ms:.0f} ms after exposure, {frames_per_s:.3g} a second, not {fps:.3g}"
    MAINS_FLICKER = (
        "the lamps flicker with the mains ({mains_hz:.0f} Hz): bands of {depth:.0%} in the images; an exposure of "
        "whole periods of the lamp has none"
    )
    STANDING_FLICKER_NOT_CHECKED = (
        "bands of lamps at {mains_hz:.0f} Hz mains would stand still in the images, and are not checked; an exposure "
        "of whole periods of the lamp has none"
    )
    FLICKER = "the light changes by {spread:.0%} within {seconds:.0f} s"
    VIEW_ACCEPTED = (
        "a view would be accepted now: mean level {mean_level:.0f}, sharpness {sharpness:.0f}, {saturated_share:.1%} "
        "saturated"
    )
    VIEW_REJECTED = "a view would be rejected now: {reasons}"
    # catalog, calibration
    NO_CATALOG = "none yet in {path}; the first enrollment creates it"
    CATALOG = "{path}: {objects} objects, {views} views; database undamaged, {images} images verified"
    DATABASE_DAMAGED = "{path}: the database is damaged: {damage}"
    IMAGES_DAMAGED = "{broken} of {images} verified images are damaged: {first}"
    UNFINISHED = "unfinished enrollments: {objects}"
    CALIBRATION = "{calibration}"
    NEVER_CALIBRATED = "{name} was never calibrated: {consequence}"
    CAMERA_DELAY = (
        "views wait {delay_ms:.0f} ms longer: by camera.time, exposures begin that long before their time stamp"
    )
    CAMERA_DELAY_UNKNOWN = (
        "a delay inside the camera does not show in its time stamps; a calibration measures it (the table rotates)"
    )
    # the scan of all devices
    NO_USB_PORT = "no serial port on USB (found: {found})"
    PORT_FAILED = "{port} failed: {reason}"
    NOTHING_ON_PORT = "{port} ({name}): no servo and no rig head answer at any baud rate"
    SERVO_FOUND = "{port}: {found}"
    SERVO_NOT_DRIVEN = "{port}: {found}: the rig cannot drive it: {reason}"
    IMU_FOUND = "{found}"
    NO_I2C = "no I2C bus"
    NO_IMU_FOUND = "no IMU answers on any I2C bus"
    NO_CAMERA = "no camera"
    RIBBON_CAMERA = "{name} on the ribbon cable: camera.source is picamera2:{number}"
    RIBBON_CAMERA_UNREACHABLE = "{name} on the ribbon cable: {what}: {reason}"


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding about the bench.

    Attributes
    ----------
    topic
        The checked part, for example ``servo``.
    level
        Its severity.
    code
        What was found.
    parameters
        The values in its text and other evidence, units in the keys.
    steps
        What fixes the problem, as the next step of an error; empty if nothing does.
    exit_code
        The exit code of `rig doctor` for this finding; 0 unless it is bad.
    """

    topic: str
    level: Severity
    code: FindingCode
    parameters: Mapping[str, Any] = field(default_factory=dict)
    steps: NextSteps = ()
    exit_code: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", masked(self.parameters))

    @property
    def fix(self) -> str:
        """What fixes the problem, as a terminal shows it."""
        return in_words(self.steps)

    def as_dict(self) -> dict[str, Any]:
        """Return the finding as `--json` prints it."""
        return {
            "topic": self.topic,
            "level": str(self.level),
            "code": self.code.name.lower(),
            "finding": finding_words(self),
            "fix": self.fix or None,
            "steps": steps_as_json(self.steps),
            "evidence": {key: _plain(value) for key, value in self.parameters.items()},
        }


def fine(topic: str, code: FindingCode, /, **parameters: Any) -> Finding:
    return Finding(topic, Severity.FINE, code, parameters)


def warning(topic: str, code: FindingCode, fix: SomeSteps, /, **parameters: Any) -> Finding:
    return Finding(topic, Severity.WARNING, code, parameters, as_steps(fix))


def bad(topic: str, code: FindingCode, fix: SomeSteps, exit_code: int = 4, /, **parameters: Any) -> Finding:
    return Finding(topic, Severity.BAD, code, parameters, as_steps(fix), exit_code)


def finding(
    level: Severity, topic: str, code: FindingCode, fix: SomeSteps, exit_code: int = 4, /, **parameters: Any
) -> Finding:
    """Return a finding of a value that may be fine or not; without a problem there is nothing to fix."""
    if level is Severity.FINE:
        return fine(topic, code, **parameters)
    return Finding(topic, level, code, parameters, as_steps(fix), exit_code * (level is Severity.BAD))


def graded(*, bad: bool, warning: bool = False) -> Severity:
    return Severity.BAD if bad else Severity.WARNING if warning else Severity.FINE


def of_error(topic: str, error: RigError, fix: SomeSteps = ()) -> Finding:
    """Return an error as a finding; the parameter ``error_code`` is the code of the error."""
    reason = error.evidence.get("reason")
    what = f"{error.what.rstrip('.')}: {reason}" if reason else error.what
    parameters = {**error.evidence, "what": what, "error_code": error.code}
    return Finding(topic, Severity.BAD, FindingCode.ERROR, parameters, as_steps(fix) or error.steps, error.exit_code)


def finding_words(finding: Finding) -> str:
    """Return the text of a finding."""
    shown = {key: _listed(value) for key, value in finding.parameters.items()}
    return filled(finding.code.value, **shown)


def _listed(value: Any) -> Any:
    return ", ".join(map(str, value)) or "none" if isinstance(value, list | tuple) else "?" if value is None else value


def _plain(value: Any) -> Any:
    """Return a value as JSON can have it; devices and dates as text."""
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)
