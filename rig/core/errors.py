"""The registry of errors: one class a kind, with a code, what happened, the evidence, and the next step.

The hundreds of a code are the exit code of the command line (design: 3 configuration, 4 device, 5 motion or safety,
6 quality, 7 catalog, 8 unknown object, 9 busy).
"""

from collections.abc import Mapping
from typing import Any, ClassVar

Evidence = Mapping[str, Any]


class RigError(Exception):
    """Base of every error that the rig raises on purpose.

    Parameters
    ----------
    what
        What happened, in a sentence.
    next_step
        What the person at the bench does now.
    evidence
        The numbers it was judged by, units in the keys.
    """

    code: ClassVar[int] = 100
    title: ClassVar[str] = "internal error"

    def __init__(self, what: str, *, next_step: str, evidence: Evidence | None = None) -> None:
        super().__init__(what)
        self.what = what
        self.next_step = next_step
        self.evidence: dict[str, Any] = dict(evidence or {})

    @property
    def exit_code(self) -> int:
        return self.code // 100

    def as_dict(self) -> dict[str, Any]:
        """Return the error for `--json` output."""
        return {
            "error": self.title,
            "code": self.code,
            "what": self.what,
            "evidence": self.evidence,
            "next_step": self.next_step,
        }


class UsageError(RigError):
    """A command or call was asked for something that cannot be."""

    code = 200
    title = "usage"


class ConfigError(RigError):
    """The configuration cannot be used; the evidence lists every mistake at once."""

    code = 300
    title = "configuration"


class DeviceNotFound(RigError):
    """A device does not answer where the configuration says it is."""

    code = 400
    title = "device not found"


class DeviceMismatch(RigError):
    """Another device answers than the one expected."""

    code = 401
    title = "wrong device"


class DeviceSilent(RigError):
    """A device stopped answering, after all retries."""

    code = 402
    title = "device silent"


class RequestRejected(RigError):
    """A device answered with an error status."""

    code = 403
    title = "device refused"


class DeviceFault(RigError):
    """A device reports that it is broken, overheated, overloaded or out of supply."""

    code = 404
    title = "device fault"


class SeveralServos(DeviceMismatch):
    """More than one servo is on a bus where there may be only one."""

    code = 405
    title = "several servos"


class FirmwareMismatch(DeviceMismatch):
    """The rig head's firmware and this program speak different versions of their protocol."""

    code = 420
    title = "other firmware"


class DeviceUnplugged(DeviceSilent):
    """The port of a device is gone from the computer."""

    code = 421
    title = "unplugged"


class LimitExceeded(RigError):
    """A motion would leave the table's limits (its cable)."""

    code = 500
    title = "limit"


class MotionTimeout(RigError):
    """The table did not arrive and settle within the computed time."""

    code = 501
    title = "motion timeout"


class RotationDisagreement(RigError):
    """Encoder and gyro differ by more than their uncertainty: slip, backlash or a loose platter."""

    code = 502
    title = "rotation disagreement"


class NotReady(RigError):
    """A motion was asked for in a state that forbids it."""

    code = 503
    title = "not ready"


class FollowingError(RigError):
    """The shaft is not where the servo's own profile wants it, or left the way to its goal."""

    code = 504
    title = "following error"


class Stalled(RigError):
    """The servo pushes and the shaft stands: something blocks the table."""

    code = 505
    title = "stalled"


class Overloaded(RigError):
    """The table turns, but takes more load than it should, for longer than a start takes."""

    code = 506
    title = "overloaded"


class Overheated(RigError):
    """The servo is close to the temperature at which it shuts down by itself."""

    code = 507
    title = "overheated"


class SupplyOutOfRange(RigError):
    """The servo's supply is close to the voltage at which it shuts down by itself."""

    code = 508
    title = "supply voltage"


class NoProgress(RigError):
    """A goal was set and nothing turns, nor pushes."""

    code = 509
    title = "no progress"


class WatchdogTripped(RigError):
    """The servo heard nothing from the computer for too long, and stopped by itself."""

    code = 510
    title = "watchdog"


class SupplyLost(RigError):
    """The servo was without supply in the middle of a motion, and forgot its turns."""

    code = 511
    title = "supply lost"


class MotionStopped(RigError):
    """Somebody asked for a stop (`rig stop`)."""

    code = 512
    title = "stopped"


class Unreferenced(NotReady):
    """How far the cable is wound up is in doubt; only a person who looks at it can tell."""

    code = 513
    title = "not referenced"


class FaultLatched(NotReady):
    """A fault was found, and nobody has acknowledged it yet."""

    code = 514
    title = "fault latched"


class StateNotStored(RigError):
    """What the next program must know about the bench (its turns, its faults) cannot be written to the disk."""

    code = 515
    title = "bench state"


class EmergencyStop(RigError):
    """The e-stop is pressed, or its loop is open: the rig head has switched off light and servo power."""

    code = 520
    title = "e-stop"


class HeartbeatLost(RigError):
    """The rig head heard nothing from this computer for too long, and made the bench safe by itself."""

    code = 521
    title = "deadman"


class HeadRestarted(RigError):
    """The rig head restarted in the middle of its work (brown-out, watchdog, reset): its outputs went off."""

    code = 522
    title = "rig head restarted"


class ViewRejected(RigError):
    """No acceptable view within the allowed retakes."""

    code = 600
    title = "view rejected"


class ObjectMoved(RigError):
    """The object does not stand any more as it stood for its first view."""

    code = 601
    title = "object moved"


class ReplayMismatch(RigError):
    """A saved run gives other decisions when it is computed again."""

    code = 602
    title = "replay mismatch"


class TableNotEmpty(RigError):
    """Something on the table turns with it where nothing should stand."""

    code = 603
    title = "table not empty"


class CatalogError(RigError):
    """The catalog cannot do what was asked."""

    code = 700
    title = "catalog"


class ObjectExists(CatalogError):
    """An object of that name is enrolled already."""

    code = 701
    title = "object exists"


class ObjectNotFound(CatalogError):
    """No object of that name is in the catalog."""

    code = 702
    title = "object not found"


class DescriptorOutdated(CatalogError):
    """Views are not described by the descriptor, or the version of it, that this program compares."""

    code = 703
    title = "descriptor outdated"


class CatalogOutdated(CatalogError):
    """The catalog is of an earlier version and is to be migrated first."""

    code = 704
    title = "catalog outdated"


class ImportRejected(CatalogError):
    """What was to be imported cannot be used; nothing of it is in the catalog."""

    code = 705
    title = "import refused"


class ExportFailed(CatalogError):
    """The catalog cannot be exported in this way."""

    code = 706
    title = "export"


class CatalogDamaged(CatalogError):
    """The catalog was checked and something in it is not as it was stored."""

    code = 707
    title = "catalog damaged"


class CatalogBusy(RigError):
    """Another process holds the catalog."""

    code = 900
    title = "busy"


class BenchBusy(RigError):
    """Another process holds the bench."""

    code = 901
    title = "bench in use"
