"""All errors: one class for each kind, with a code, what happened, the evidence, and the next step.

The hundreds of a code are the exit code of the command line: 2 usage, 3 configuration, 4 device, 5 motion or safety,
6 quality, 7 catalog, 8 unknown object, 9 busy. Decisions use the class, never the text.
"""

from collections.abc import Mapping
from typing import Any, ClassVar, Self

Evidence = Mapping[str, Any]


class RigError(Exception):
    """Base of every error that the rig raises on purpose.

    Parameters
    ----------
    what
        What happened, in a sentence.
    next_step
        What the operator does now: an imperative.
    evidence
        The numbers behind the decision, with units in the keys.
    """

    code: ClassVar[int] = 100
    title: ClassVar[str] = "internal error"
    latches: ClassVar[bool] = False
    """Whether the error latches a fault when it ends a motion: the operator must look at the bench."""

    def __init__(self, what: str, *, next_step: str, evidence: Evidence | None = None) -> None:
        super().__init__(what)
        self.what = what
        self.next_step = next_step
        self.evidence: dict[str, Any] = dict(evidence or {})
        self._asks_to_acknowledge = False

    @property
    def exit_code(self) -> int:
        return self.code // 100

    def ask_to_acknowledge(self, *, reboot: bool = False) -> Self:
        """Add `rig acknowledge` to the next step, once; with ``reboot`` if only a restart clears the fault."""
        if not self._asks_to_acknowledge:
            self._asks_to_acknowledge = True
            self.next_step += f" Then `rig acknowledge{' --reboot' * reboot}`."
        return self

    def as_dict(self) -> dict[str, Any]:
        """Return the error as `--json` prints it."""
        return {
            "error": self.title,
            "code": self.code,
            "what": self.what,
            "evidence": self.evidence,
            "next_step": self.next_step,
        }


class UsageError(RigError):
    """A command or function was called with arguments that are not possible."""

    code = 200
    title = "usage"


class ConfigError(RigError):
    """The configuration has mistakes; the evidence lists all of them."""

    code = 300
    title = "configuration"


class DeviceNotFound(RigError):
    """No device answers at the place that the configuration names."""

    code = 400
    title = "device not found"


class DeviceMismatch(RigError):
    """The device that answers is not the expected one."""

    code = 401
    title = "wrong device"


class DeviceSilent(RigError):
    """A device stopped answering, also after all retries."""

    code = 402
    title = "device silent"


class RequestRejected(RigError):
    """A device answered a request with an error status."""

    code = 403
    title = "request rejected"


class DeviceFault(RigError):
    """A device reports that it is broken, overheated, overloaded or without supply."""

    code = 404
    title = "device fault"
    latches = True


class SeveralServos(DeviceMismatch):
    """More than one servo is on a bus that may have only one."""

    code = 405
    title = "several servos"


class FirmwareMismatch(DeviceMismatch):
    """The rig head's firmware and this program use different versions of the protocol."""

    code = 420
    title = "firmware mismatch"


class DeviceUnplugged(DeviceSilent):
    """The port of a device disappeared from the computer."""

    code = 421
    title = "unplugged"


class LimitExceeded(RigError):
    """A motion would exceed the table's limits, which protect its cable."""

    code = 500
    title = "limit"


class MotionTimeout(RigError):
    """The table did not arrive and settle within the computed time."""

    code = 501
    title = "motion timeout"
    latches = True


class RotationDisagreement(RigError):
    """Encoder and gyro differ by more than their uncertainty: slip, backlash or a loose platter."""

    code = 502
    title = "rotation disagreement"
    latches = True


class NotReady(RigError):
    """A motion was requested in a state that does not allow it."""

    code = 503
    title = "not ready"


class FollowingError(RigError):
    """The shaft does not follow the servo's motion profile, or left the path to its goal."""

    code = 504
    title = "following error"
    latches = True


class Stalled(RigError):
    """The servo pushes but the shaft does not rotate: something blocks the table."""

    code = 505
    title = "stalled"
    latches = True


class Overloaded(RigError):
    """The table rotates, but its load is too high for longer than a start takes."""

    code = 506
    title = "overloaded"
    latches = True


class Overheated(RigError):
    """The servo is close to the temperature at which it shuts down."""

    code = 507
    title = "overheated"
    latches = True


class SupplyOutOfRange(RigError):
    """The servo's supply is close to a voltage at which it shuts down."""

    code = 508
    title = "supply voltage"
    latches = True


class NoProgress(RigError):
    """The servo has a goal, but it neither rotates nor pushes."""

    code = 509
    title = "no progress"
    latches = True


class WatchdogTripped(RigError):
    """The servo received nothing from the computer for too long, and its watchdog stopped it."""

    code = 510
    title = "watchdog"


class SupplyLost(RigError):
    """The servo lost its supply during a motion, and with it the count of its revolutions."""

    code = 511
    title = "supply lost"


class MotionStopped(RigError):
    """The operator stopped the table with `rig stop`."""

    code = 512
    title = "stopped"


class Unreferenced(NotReady):
    """It is not known how far the cable is wound up; the operator must look at it."""

    code = 513
    title = "not referenced"


class FaultLatched(NotReady):
    """A fault is latched, and the operator has not acknowledged it yet."""

    code = 514
    title = "fault latched"


class StateNotStored(RigError):
    """The bench's state (revolutions, latched fault), which the next program needs, cannot be written to disk."""

    code = 515
    title = "bench state"


class EmergencyStop(RigError):
    """The e-stop is pressed, or its loop is open: the rig head switched off light and servo power."""

    code = 520
    title = "e-stop"
    latches = True


class HeartbeatLost(RigError):
    """The rig head received no heartbeat from this computer for too long, and switched its outputs off."""

    code = 521
    title = "deadman"
    latches = True


class HeadRestarted(RigError):
    """The rig head restarted during its work (brown-out, watchdog, reset), which switched its outputs off."""

    code = 522
    title = "rig head restarted"
    latches = True


class ViewRejected(RigError):
    """No view was acceptable within the allowed retakes."""

    code = 600
    title = "view rejected"


class ObjectMoved(RigError):
    """The object moved on the table since its first view."""

    code = 601
    title = "object moved"


class ReplayMismatch(RigError):
    """A saved run leads to different decisions when it is computed again."""

    code = 602
    title = "replay mismatch"


class TableNotEmpty(RigError):
    """Something is on the table, which should be empty."""

    code = 603
    title = "table not empty"


class CatalogError(RigError):
    """The catalog cannot do what was requested."""

    code = 700
    title = "catalog"


class ObjectExists(CatalogError):
    """An object of that name is already enrolled."""

    code = 701
    title = "object exists"


class ObjectNotFound(CatalogError):
    """No object of that name is in the catalog."""

    code = 702
    title = "object not found"


class DescriptorOutdated(CatalogError):
    """Views lack the descriptor, or the version of it, that this program compares."""

    code = 703
    title = "descriptor outdated"


class CatalogOutdated(CatalogError):
    """The catalog has an earlier version and must be migrated first."""

    code = 704
    title = "catalog outdated"


class ImportRejected(CatalogError):
    """The import cannot be used; the catalog did not change."""

    code = 705
    title = "import rejected"


class ExportFailed(CatalogError):
    """The catalog cannot be exported in this way."""

    code = 706
    title = "export failed"


class CatalogDamaged(CatalogError):
    """A check found that something in the catalog is not as it was stored."""

    code = 707
    title = "catalog damaged"


class CatalogBusy(RigError):
    """Another process uses the catalog."""

    code = 900
    title = "busy"


class BenchBusy(RigError):
    """Another process uses the bench."""

    code = 901
    title = "bench in use"
