"""How long an enrollment takes, and where the table goes for it: known before anything moves."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, floor
from typing import Final

from hbr.core.angles import wrap360
from rig.bench import Bench
from rig.catalog import Catalog, ObjectSummary, clean_name
from rig.core.clock import seconds_between
from rig.core.errors import LimitExceeded
from rig.events.events import Accepted, Event
from rig.motion.motion_model import MotionModel
from rig.motion.turntable import Turntable

_FLOAT_DEG: Final = 1e-6


def even_azimuths(views: int, limits_deg: tuple[float, float], sign: int = -1) -> list[float]:
    """Return the azimuths of ``views`` even steps of one turn, in the order in which the table takes them.

    They begin at azimuth 0, where the cable's limits let the table turn up from 0; else further back. Of a servo that
    pans over less than a turn they are those within its limits: the object is seen from some of its sides.

    Parameters
    ----------
    views
        How many there would be in a whole turn.
    limits_deg
        Lowest and highest table angle.
    sign
        Sense of the orientation: -1 where the table turns the object, +1 where it takes the camera around it
        (`TableConfig.orientation_sign`).
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
    """Return the table's angle, unwrapped, for each planned azimuth: upwards all the way, within the limits.

    The table turns backwards under a camera that goes around (``sign`` -1), and upwards so that its play stays taken
    up.

    Raises
    ------
    LimitExceeded
        The cable does not reach for so many views in a row.
    """
    if not azimuth_deg:
        return ()
    angles = [sign * float(wrap360(azimuth_deg[0]))]
    for before, after in pairwise(azimuth_deg):
        angles.append(angles[-1] + float(wrap360(sign * (after - before))))
    low, high = limits_deg
    turns = [
        whole
        for whole in range(int(low // 360) - 1, int(high // 360) + 3)
        if low - _FLOAT_DEG <= angles[0] + 360.0 * whole and angles[-1] + 360.0 * whole <= high + _FLOAT_DEG
    ]
    if not turns:
        raise LimitExceeded(
            f"The cable does not reach for these views: they take {angles[-1] - angles[0]:.0f}° in one direction.",
            next_step="Widen table.limits_deg if the cable allows it, or enroll the object anew with --replace: "
            "views planned on this bench fit its cable.",
            evidence={
                "from_deg": angles[0],
                "to_deg": angles[-1],
                "limits_deg": list(limits_deg),
            },
        )
    nearest = min(turns, key=lambda whole: (abs(angles[0] + 360.0 * whole), whole))
    return tuple(angle + 360.0 * nearest for angle in angles)


@dataclass(frozen=True, slots=True)
class DryRun:
    """What an enrollment would do.

    ``action`` is "enroll", "resume", "replace", "skip" (it is enrolled already) or "refuse", with the reason in
    ``why``. ``angles_deg`` are the table's, unwrapped, of the views in their order, ``azimuths_deg`` the views';
    ``table_deg`` is where the table stands before, ``travel_deg`` what it turns through in all, unwinding included.
    """

    name: str
    action: str
    why: str
    views: int
    azimuths_deg: tuple[float, ...]
    angles_deg: tuple[float, ...]
    table_deg: float
    limits_deg: tuple[float, float]
    travel_deg: float
    seconds: float


def dry_run(
    bench: Bench,
    catalog: Catalog | None,
    names: Sequence[str],
    *,
    views: int | None = None,
    resume: bool = False,
    replace: bool = False,
) -> tuple[DryRun, ...]:
    """Say what enrolling these objects would do; nothing moves and nothing is stored.

    Parameters
    ----------
    bench
        An open one.
    catalog
        None where none was made yet.
    names
        Of the objects. Of more than one, complete ones are skipped and interrupted ones resumed, as a tray does.
    views, resume, replace
        As for `enroll`.

    Raises
    ------
    UsageError
        A name cannot be used.
    LimitExceeded
        The cable does not reach for the views that are left.
    """
    known = {} if catalog is None else {summary.name: summary for summary in catalog.objects()}
    table_deg = Turntable(bench).angle_deg()
    limits_deg, sign = bench.config.table.limits_deg, bench.config.table.orientation_sign
    model = MotionModel(bench.config)
    found = []
    for name in map(clean_name, names):
        action, why = _action(known.get(name), resume=resume, replace=replace, tray=len(names) > 1)
        azimuths: Sequence[float] = ()
        if action in ("enroll", "replace"):
            azimuths = even_azimuths(views or bench.config.enroll.views, limits_deg, sign)
            angles = table_angles(azimuths, limits_deg, sign)
        elif action == "resume" and catalog is not None and (kept := catalog.resumable(name)) is not None:
            every = table_angles(kept.planned_azimuth_deg, limits_deg, sign)
            azimuths = [kept.planned_azimuth_deg[index] for index in kept.missing]
            angles = tuple(every[index] for index in kept.missing)
        else:
            angles = ()
        stops = [table_deg, *angles, 0.0] if angles else [table_deg]
        found.append(
            DryRun(
                name=name,
                action=action,
                why=why,
                views=len(angles),
                azimuths_deg=tuple(azimuths),
                angles_deg=angles,
                table_deg=table_deg,
                limits_deg=limits_deg,
                travel_deg=sum(abs(b - a) for a, b in pairwise(stops)),
                seconds=model.enrollment_s(table_deg, angles),
            )
        )
        table_deg = 0.0 if angles else table_deg
    return tuple(found)


def _action(known: ObjectSummary | None, *, resume: bool, replace: bool, tray: bool) -> tuple[str, str]:
    unfinished = known.unfinished_views if known else None
    if unfinished is not None:
        if resume or tray:
            return "resume", ""
        return ("replace", "") if replace else ("refuse", "its enrollment is unfinished: add --resume or --replace")
    if resume:
        return "refuse", "it has no unfinished enrollment: leave --resume out"
    if known is not None and known.views:
        if replace:
            return "replace", ""
        why = f"it is enrolled already, with {known.views} views"
        return ("skip", why) if tray else ("refuse", f"{why}: add --replace to enroll it anew")
    return "enroll", ""


class TimeLeft:
    """Time left of an enrollment: the motion model, corrected by how long the views so far really took.

    Parameters
    ----------
    model
        Of the bench.
    angles_deg
        Table angles of the views to come, in their order.
    """

    def __init__(self, model: MotionModel, angles_deg: Sequence[float]) -> None:
        self._model = model
        self._angles_deg = angles_deg
        self._done = 0
        self._exposed_ns: list[int] = []

    def add(self, event: Event) -> None:
        """Take the next event of the plan."""
        if isinstance(event, Accepted):
            self._done += 1
            self._exposed_ns.append(event.evidence.exposed_ns)

    @property
    def seconds(self) -> float:
        """Time of the bench until the table is back at 0."""
        model, done, angles = self._model, self._done, self._angles_deg
        if not angles:
            return 0.0
        if not done:
            return model.enrollment_s(angles[0], angles)
        left = sum(model.move_s(b - a) + model.view_s for a, b in pairwise(angles[done - 1 :]))
        expected = sum(model.move_s(b - a) + model.view_s for a, b in pairwise(angles[:done]))
        if done > 1 and expected > 0:
            left *= seconds_between(self._exposed_ns[0], self._exposed_ns[-1]) / expected
        return left + model.move_s(-angles[-1])
