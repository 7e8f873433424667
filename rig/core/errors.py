"""All errors: one class for each kind, with a code, what happened, the evidence, and the next step.

The hundreds of a code are the exit code of the command line: 2 usage, 3 configuration, 4 device, 5 motion or safety,
6 quality, 7 catalog, 8 unknown object, 9 busy. Decisions use the class, never the text.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final

from rig.core.json_form import plain
from rig.core.masking import masked
from rig.core.next_steps import Do, NextSteps, SomeSteps, as_steps, in_words

Evidence = Mapping[str, Any]
ERRORS: Final = "/reference/errors.html"
"""The page of all errors, with an anchor for each code: in the documentation, and of each server without a network."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """An error (RFC 9457), the same in ``--json``, in events, in the REST API and in all that is stored."""

    # This and the text of the next step follow from the rest, also when a problem is read.
    type: str = ""
    """Address of its description, on each server and in the documentation."""
    title: str
    """Kind of the error."""
    code: int
    """Number of the kind; its hundreds are the exit code of a command."""
    detail: str
    """What happened, in a sentence."""
    evidence: dict[str, Any] = field(default_factory=dict)
    """Measurements and names that show the error."""
    next_step: str = ""
    """What the operator should do, as a terminal shows it."""
    steps: NextSteps
    """The same as data, in order: sentences for what only hands can do, and actions of the rig."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "type", f"{ERRORS}#{self.code}")
        object.__setattr__(self, "next_step", in_words(self.steps))


class RigError(Exception):
    """Base of every error that the rig raises on purpose. Its texts and its evidence are `masked`.

    ``what`` happened is a sentence. ``next_step`` is what the operator does now: sentences in the imperative for what
    only hands can do, and actions of the rig (`rig.core.next_steps`), in order; ``steps`` are the same. ``evidence``
    has the numbers that led to the error, with units in the keys.
    """

    code: ClassVar[int] = 100
    title: ClassVar[str] = "internal error"
    latches: ClassVar[bool] = False
    """Whether the error latches a fault when it ends a motion: the operator must look at the bench."""

    def __init_subclass__(cls, *, code: int, title: str, latches: bool | None = None) -> None:
        super().__init_subclass__()
        cls.code, cls.title = code, title
        if latches is not None:
            cls.latches = latches

    def __init__(self, what: str, *, next_step: SomeSteps, evidence: Evidence | None = None) -> None:
        what = masked(what)
        super().__init__(what)
        self.what: str = what
        self.evidence: dict[str, Any] = masked(evidence or {})
        self.steps: NextSteps = as_steps(next_step)

    @property
    def next_step(self) -> str:
        """The next step as a terminal shows it."""
        return in_words(self.steps)

    @property
    def exit_code(self) -> int:
        return self.code // 100

    @property
    def problem(self) -> Problem:
        """The error as data."""
        evidence = plain(self.evidence)
        return Problem(title=self.title, code=self.code, detail=self.what, evidence=evidence, steps=self.steps)


def error_kinds() -> list[type[RigError]]:
    """Return every kind of error by its code."""
    found: list[type[RigError]] = [RigError]
    for kind in found:  # grows while it is read
        found += [sub for sub in kind.__subclasses__() if sub.__module__ == RigError.__module__]
    return sorted(set(found), key=lambda kind: kind.code)


def error_of(problem: Problem) -> RigError:
    """Return the error of which ``problem`` is the data."""
    kind = next((one for one in error_kinds() if one.code == problem.code), RigError)
    return kind(problem.detail, next_step=problem.steps, evidence=problem.evidence)


@contextmanager
def os_errors_as(kind: type[RigError], what: str, *, next_step: SomeSteps) -> Iterator[None]:
    """Raise an `OSError` in the ``with`` block as an error of ``kind``, with the system's reason as evidence."""
    try:
        yield
    except OSError as error:
        raise kind(what, next_step=next_step, evidence={"reason": error.strerror or str(error)}) from error


class UsageError(RigError, code=200, title="usage"):
    """A command or function was called with arguments that are not possible."""


class OutputFailed(RigError, code=201, title="output"):
    """The standard output cannot be written: its disk is full or fails."""


class LoginRequired(RigError, code=202, title="login required"):
    """A request to the server has no valid token or login."""


class Forbidden(RigError, code=203, title="forbidden"):
    """The token of a request does not allow it."""


class JobNotFound(RigError, code=204, title="job not found"):
    """The server has no job, run or picture with that name."""


class ConfigError(RigError, code=300, title="configuration"):
    """The configuration has mistakes; the evidence lists all of them."""


class ExtraMissing(ConfigError, code=301, title="package missing"):
    """A function needs optional packages that are not installed."""

    @classmethod
    def of(cls, extra: str, what: str, error: ImportError) -> "ExtraMissing":
        """Return the error that ``what`` needs the packages of an extra."""
        return cls(
            f"{what} need packages that are not installed.",
            next_step=Do.INSTALL_EXTRA(extra=extra),
            evidence={"missing": error.name or str(error)},
        )


class DeviceNotFound(RigError, code=400, title="device not found"):
    """No device answers at the place that the configuration names."""


class DeviceMismatch(RigError, code=401, title="wrong device"):
    """The device that answers is not the expected one."""


class DeviceSilent(RigError, code=402, title="device silent"):
    """A device stopped answering, even after all retries."""


class RequestRejected(RigError, code=403, title="request rejected"):
    """A device answered a request with an error status."""


class DeviceFault(RigError, code=404, title="device fault", latches=True):
    """A device reports that it is broken, overheated, overloaded or without supply."""


class SeveralServos(DeviceMismatch, code=405, title="several servos"):
    """More than one servo is on a bus that may have only one."""


class FirmwareMismatch(DeviceMismatch, code=420, title="firmware mismatch"):
    """The rig head's firmware and this program use different versions of the protocol."""


class ControllerHangs(DeviceSilent, code=422, title="I2C controller hangs"):
    """The computer's I2C controller ends no transfer, also after the bus was opened again."""


class DeviceUnplugged(DeviceSilent, code=421, title="unplugged"):
    """The port of a device disappeared from the computer."""


class LimitExceeded(RigError, code=500, title="limit"):
    """A motion would exceed the table's limits, which protect its cable."""


class MotionTimeout(RigError, code=501, title="motion timeout", latches=True):
    """The table did not arrive and settle within the computed time."""


class RotationDisagreement(RigError, code=502, title="rotation disagreement", latches=True):
    """Encoder and gyro differ by more than their uncertainty: slip, backlash or a loose platter."""


class NotReady(RigError, code=503, title="not ready"):
    """A motion was requested in a state that does not allow it."""


class FollowingError(RigError, code=504, title="following error", latches=True):
    """The shaft does not follow the servo's motion profile, or left the path to its goal."""


class Stalled(RigError, code=505, title="stalled", latches=True):
    """The servo pushes but the shaft does not rotate: something blocks the table."""


class Overloaded(RigError, code=506, title="overloaded", latches=True):
    """The table rotates, but its load is too high for longer than a start takes."""


class Overheated(RigError, code=507, title="overheated", latches=True):
    """The servo is close to the temperature at which it shuts down."""


class SupplyOutOfRange(RigError, code=508, title="supply voltage", latches=True):
    """The servo's supply is close to a voltage at which it shuts down."""


class NoProgress(RigError, code=509, title="no progress", latches=True):
    """The servo has a goal, but it neither rotates nor pushes."""


class WatchdogTripped(RigError, code=510, title="watchdog"):
    """The servo received nothing from the computer for too long, and its watchdog stopped it."""


class SupplyLost(RigError, code=511, title="supply lost"):
    """The servo lost its supply during a motion, and with it the count of its revolutions."""


class MotionStopped(RigError, code=512, title="stopped"):
    """The operator stopped the table."""


class Unreferenced(NotReady, code=513, title="not referenced"):
    """It is not known how far the cable is wound up; the operator must look at it."""


class FaultLatched(NotReady, code=514, title="fault latched"):
    """A fault is latched, and the operator has not acknowledged it yet."""


class StateNotStored(RigError, code=515, title="bench state"):
    """The bench's state (revolutions, latched fault), which the next program needs, cannot be written to disk."""


class TorqueStaysOn(RigError, code=516, title="torque on", latches=True):
    """The servo accepted the instruction to switch its torque off, but its torque is still on."""


class EmergencyStop(RigError, code=520, title="e-stop", latches=True):
    """The e-stop is pressed, or its loop is open: the rig head switched off light and servo power."""


class HeartbeatLost(RigError, code=521, title="deadman", latches=True):
    """The rig head received no heartbeat from this computer for too long, and switched its outputs off."""


class HeadRestarted(RigError, code=522, title="rig head restarted", latches=True):
    """The rig head restarted during its work (brown-out, watchdog, reset), which switched its outputs off."""


class ViewRejected(RigError, code=600, title="view rejected"):
    """No view was acceptable within the allowed retakes."""


class ObjectMoved(RigError, code=601, title="object moved"):
    """The object moved on the table since its first view."""


class ReplayMismatch(RigError, code=602, title="replay mismatch"):
    """A saved run leads to different decisions when it is computed again, or devices differ from a trace."""


class RunIncomplete(RigError, code=604, title="run incomplete"):
    """A saved run is cut off, or has no answer."""


class CameraSettingsDiffer(RigError, code=605, title="camera settings differ"):
    """The camera's settings are not those of the enrollments, so views cannot be compared."""


class TableNotEmpty(RigError, code=603, title="table not empty"):
    """Something is on the table, which should be empty."""


class NoObject(RigError, code=606, title="no object"):
    """The table is empty, so there is nothing to enroll or to identify."""


class CatalogError(RigError, code=700, title="catalog"):
    """The catalog cannot do what was requested."""


class ObjectExists(CatalogError, code=701, title="object exists"):
    """An object of that name is already enrolled."""


class ObjectNotFound(CatalogError, code=702, title="object not found"):
    """No object of that name is in the catalog."""


class ImportRejected(CatalogError, code=705, title="import rejected"):
    """The import cannot be used; the catalog did not change."""


class ExportFailed(CatalogError, code=706, title="export failed"):
    """The catalog cannot be exported in this way."""


class CatalogDamaged(CatalogError, code=707, title="catalog damaged"):
    """A check found that something in the catalog is not as it was stored."""


class CatalogUnavailable(CatalogError, code=708, title="catalog not reachable"):
    """The server of the catalog, or the store of its images, does not answer."""


class CatalogBusy(RigError, code=900, title="busy"):
    """Another process uses the catalog."""


class BenchBusy(RigError, code=901, title="bench in use"):
    """Another process uses the bench."""


class LeaseHeld(RigError, code=902, title="lease held"):
    """Another operator of the server uses the bench."""


class JobRejected(RigError, code=903, title="job rejected"):
    """The job cannot do that in its state, or too many jobs wait."""


class TooManyListeners(RigError, code=904, title="too many listeners"):
    """Too many streams of events or pictures of the server are open."""


class WebEnded(RigError, code=905, title="web process"):
    """The process that answers the web ends again and again."""
