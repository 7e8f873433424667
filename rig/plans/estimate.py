"""The plan of an enrollment before anything moves: table angles, duration, and whether it is possible."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import pairwise
from math import ceil, floor
from typing import Final

from hbr.core.angles import wrap360
from rig.bench import Bench
from rig.catalog import Catalog, ObjectSummary, clean_name
from rig.core.clock import seconds_between
from rig.core.errors import LimitExceeded
from rig.core.next_steps import Do
from rig.events.events import Accepted, Event
from rig.motion.move import MotionTimes
from rig.motion.scan_speed import takes_in_motion
from rig.motion.turntable import Turntable

_FLOAT_DEG: Final = 1e-6  # a limit that a float misses by rounding still counts as reached


def even_azimuths(views: int, limits_deg: tuple[float, float], sign: int = -1) -> list[float]:
    """Return the azimuths of ``views`` even steps of a revolution, in the order in which the table takes them.

    The first azimuth is 0 if the cable budget allows a revolution upwards from the table angle 0; otherwise the table
    starts further back. If the limits allow less than a revolution, only the azimuths within them are returned.
    """
    step_deg = 360.0 / views
    low, high = limits_deg
    start_deg = 0.0
    if 360.0 - step_deg > high - low:
        start_deg = ceil(low / step_deg - _FLOAT_DEG) * step_deg
        views = floor((high - start_deg) / step_deg + _FLOAT_DEG) + 1
    elif 360.0 - step_deg > high:
        start_deg = max((high - (360.0 - step_deg)) // step_deg * step_deg, low)
    return [float(wrap360(sign * (start_deg + k * step_deg))) for k in range(views)]


def table_angles(azimuth_deg: Sequence[float], limits_deg: tuple[float, float], sign: int = -1) -> tuple[float, ...]:
    """Return the unwrapped table angle for each planned azimuth: always upwards, and within the limits.

    The table always rotates upwards, so that the backlash stays on one side.

    Raises `LimitExceeded`: the cable budget does not allow this number of views in one direction.
    """
    if not azimuth_deg:
        return ()
    angles = [sign * float(wrap360(azimuth_deg[0]))]
    for before, after in pairwise(azimuth_deg):
        angles.append(angles[-1] + float(wrap360(sign * (after - before))))
    low, high = limits_deg
    revolutions = [
        whole
        for whole in range(int(low // 360) - 1, int(high // 360) + 3)
        if low - _FLOAT_DEG <= angles[0] + 360.0 * whole and angles[-1] + 360.0 * whole <= high + _FLOAT_DEG
    ]
    if not revolutions:
        raise LimitExceeded(
            f"The views need {angles[-1] - angles[0]:.0f}° in one direction. The cable budget does not allow that.",
            next_step=(
                "Increase table.limits_deg if the cable is long enough. Otherwise,",
                Do.ENROLL_AGAIN(),
                "The views are then planned for this bench.",
            ),
            evidence={"from_deg": angles[0], "to_deg": angles[-1], "limits_deg": list(limits_deg)},
        )
    nearest = min(revolutions, key=lambda whole: (abs(angles[0] + 360.0 * whole), whole))
    return tuple(angle + 360.0 * nearest for angle in angles)


class Obstacle(StrEnum):
    """The reason why an object would not be enrolled."""

    ALREADY_ENROLLED = "already_enrolled"
    INTERRUPTED = "interrupted"
    NOT_INTERRUPTED = "not_interrupted"


@dataclass(frozen=True, slots=True)
class DryRun:
    """The plan of an enrollment that is not carried out.

    ``action`` is "enroll", "resume", "replace", "skip" or "reject"; the last two have an ``obstacle``.
    ``enrolled_views`` is the number of views that the object has already. ``angles_deg`` and ``azimuths_deg`` are those
    of the views in their order. ``table_deg`` is the table angle before; ``travel_deg`` is the sum of all rotations,
    unwinding included. ``in_motion`` is whether the views are taken in one revolution.
    """

    name: str
    action: str
    obstacle: Obstacle | None
    enrolled_views: int
    views: int
    azimuths_deg: tuple[float, ...]
    angles_deg: tuple[float, ...]
    table_deg: float
    limits_deg: tuple[float, float]
    travel_deg: float
    seconds: float
    in_motion: bool = False


def dry_run(
    bench: Bench,
    catalog: Catalog | None,
    names: Mapping[str, int | None],
    *,
    views: int | None = None,
    resume: bool = False,
    replace: bool = False,
    fly: bool | None = None,
) -> tuple[DryRun, ...]:
    """Return the plans of enrolling these objects. Nothing moves and nothing is stored.

    Parameters
    ----------
    bench
        An open bench.
    catalog
        None if there is none yet.
    names
        Names of the objects, with their own number of views if they have one. Of several objects, complete ones are
        skipped and interrupted ones resumed, as in a tray.
    views, resume, replace, fly
        As for `enroll`.

    Raises `UsageError`: a name cannot be used. `LimitExceeded`: the cable budget does not allow the missing views.
    """
    known = {} if catalog is None else {summary.name: summary for summary in catalog.known_objects()}
    table_deg = Turntable(bench).angle_deg()
    limits_deg, sign = bench.config.table.limits_deg, bench.config.table.orientation_sign
    model = MotionTimes(bench.config)
    found = []
    for given, own_views in names.items():
        name = clean_name(given)
        summary = known.get(name)
        # What the enrollment would take, from where the object before it leaves the table.
        action, obstacle = planned_action(summary, resume=resume, replace=replace, tray=len(names) > 1)
        planned: Sequence[float] = ()
        if action in ("enroll", "replace"):
            planned = even_azimuths(own_views or views or bench.config.enroll.views, limits_deg, sign)
        missing: Sequence[int] = range(len(planned))
        if action == "resume" and catalog is not None and (kept := catalog.resumable(name)) is not None:
            planned, missing = kept.enrollment.planned_azimuth_deg, kept.enrollment.missing
        every = table_angles(planned, limits_deg, sign)
        angles = tuple(every[index] for index in missing)
        in_motion = takes_in_motion(bench.config, fly, tray=len(names) > 1)
        scan = (angles[0], angles[0] + 360.0) if in_motion and angles else angles
        stops = [table_deg, *scan, 0.0] if angles else [table_deg]
        found.append(
            DryRun(
                name=name,
                action=action,
                obstacle=obstacle,
                enrolled_views=summary.views if summary else 0,
                views=len(angles),
                azimuths_deg=tuple(planned[index] for index in missing),
                angles_deg=angles,
                table_deg=table_deg,
                limits_deg=limits_deg,
                travel_deg=sum(abs(b - a) for a, b in pairwise(stops)),
                seconds=model.enrollment_s(table_deg, angles, in_motion=in_motion),
                in_motion=in_motion,
            )
        )
        table_deg = 0.0 if angles else table_deg
    return tuple(found)


def planned_action(
    known: ObjectSummary | None, *, resume: bool = False, replace: bool = False, tray: bool = False
) -> tuple[str, Obstacle | None]:
    """Return what an enrollment does with an object of the catalog, as in `DryRun`; None: the catalog has none."""
    if known is not None and known.unfinished_views is not None:
        if resume or tray:
            return "resume", None
        return ("replace", None) if replace else ("reject", Obstacle.INTERRUPTED)
    if resume:
        return "reject", Obstacle.NOT_INTERRUPTED
    if known is not None and known.views:
        return ("replace", None) if replace else ("skip" if tray else "reject", Obstacle.ALREADY_ENROLLED)
    return "enroll", None


@dataclass(eq=False)
class TimeLeft:
    """Remaining time of an enrollment: the motion model, scaled by the time that the views so far really took.

    ``model`` gives the durations of moves and views, ``angles_deg`` are the table angles of the coming views. Views
    ``in_motion`` are taken in one revolution, and reported after it.
    """

    model: MotionTimes
    angles_deg: Sequence[float]
    in_motion: bool = False
    _exposed_ns: list[int] = field(default_factory=list, init=False)

    def add(self, event: Event) -> None:
        """Take the next event of the plan."""
        if isinstance(event, Accepted):
            self._exposed_ns.append(event.evidence.exposed_ns)

    @property
    def seconds(self) -> float:
        """Remaining time in the bench's clock, until the table is back at 0."""
        model, done, angles = self.model, len(self._exposed_ns), self.angles_deg
        if not angles:
            return 0.0
        if not done:
            return model.enrollment_s(angles[0], angles, in_motion=self.in_motion)
        if self.in_motion:
            return model.park_s(angles[0] + 360.0)
        left, expected = model.views_s(angles[done - 1 :]), model.views_s(angles[:done])
        if expected > 0:
            left *= seconds_between(self._exposed_ns[0], self._exposed_ns[-1]) / expected
        return left + model.move_s(-angles[-1])
