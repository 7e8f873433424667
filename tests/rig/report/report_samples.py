"""Event streams as the plans yield them, for the tests of the reports."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hbr import Outcome, StopDecision, StopReason
from hbr.core.angles import wrap180, wrap360
from rig.devices.camera import CameraLocks
from rig.events.events import (
    Accepted,
    Candidate,
    Decided,
    Enrolled,
    Event,
    Identified,
    Moved,
    Note,
    NoteCode,
    Ranked,
    Rejected,
    RotationReason,
    Started,
    Weighed,
)
from rig.report import TILE, Record, Truth
from rig.safety.gyro_rotation import Stillness
from rig.views.capture import ViewEvidence
from rig.views.description import BENCH_DESCRIPTOR

NAMES = ("mug-white", "mug-star", "teapot", "vase-blue", "lamp")


NOTE = Note(NoteCode.ENROLLED_WITHOUT_EMPTY_TABLE)


def evidence(sharpness: float = 100.0) -> ViewEvidence:
    locks = CameraLocks(8000.0, None, 5000.0, False, False)
    return ViewEvidence(10, 20, sharpness, 90.0, 0.0, 0.0, False, locks, True, Stillness(0.05, 0.0, 0.0, True))


def moved(index: int, commanded_deg: float, rotation_deg: float) -> Moved:
    return Moved(index, commanded_deg, commanded_deg + 0.04, rotation_deg, rotation_deg + 0.1, 0.1, 0.5, True, 1.0)


def noise(rng: np.random.Generator, shape: tuple[int, int] = (48, 64)) -> NDArray[np.uint8]:
    return rng.integers(0, 256, (*shape, 3), dtype=np.uint8)


def enrolling(
    name: str = "mug-white", views: int = 8, *, retaken: Sequence[int] = (), shape: tuple[int, int] = (48, 64)
) -> Iterator[Event]:
    rng = np.random.default_rng(views)
    yield Started("enroll", name, views, {}, angles_deg=tuple(360.0 * k / views for k in range(views)))
    for k in range(views):
        yield moved(k, 360.0 * k / views, 360.0 / views if k else 0.0)
        if k in retaken:
            yield Rejected(k, 1, ("blurred (sharpness 2.0 < 3)",), evidence(2.0))
        yield Accepted(k, float(wrap360(-360.0 * k / views)), evidence(100.0 + k), noise(rng, shape))
    yield Enrolled(name, views, len(retaken), 12.0)


def identifying(
    answer: str | None = "mug-white",
    rotations_deg: Sequence[float] = (90.0, 47.3, -120.5),
    *,
    yaw_deg: float = 30.0,
    names: Sequence[str] = NAMES,
    shape: tuple[int, int] = (48, 64),
    min_score: float = 0.75,
) -> Iterator[Event]:
    """Yield a search with these rotations; the candidates' scores are (0.9 - 0.1 rank) + 0.01 for each view."""
    rng = np.random.default_rng(5)
    yield Started("identify", None, 8, {})
    orientation_deg = 0.0
    for k in range(len(rotations_deg) + 1):
        rotation_deg = rotations_deg[k - 1] if k else 0.0
        orientation_deg += rotation_deg
        yield moved(k, -orientation_deg, -rotation_deg)
        yield Accepted(k, float(wrap360(orientation_deg)), evidence(), noise(rng, shape))
        pose_deg = float(wrap360(orientation_deg - yaw_deg))
        candidates = tuple(Candidate(n, 0.9 - 0.1 * i + 0.01 * k, pose_deg) for i, n in enumerate(names))
        yield Ranked(k, candidates, 0.1)
        if k < len(rotations_deg):
            step_deg = rotations_deg[k]
            s_left, s_right = (None, None) if k == 0 else (0.41, 0.66) if step_deg >= 0 else (0.66, 0.41)
            side = "left" if step_deg >= 0 else "right"
            reason = RotationReason.LESS_SIMILAR_SIDE if k else RotationReason.FIRST_STEP
            yield Decided(k, side, step_deg, -orientation_deg - step_deg, s_left, s_right, tuple(names), reason)
    travelled_deg = sum(map(abs, rotations_deg))
    yield Identified(
        answer,
        candidates,
        candidates[0].score,
        0.1,
        pose_deg,
        yaw_deg,
        k + 1,
        travelled_deg,
        9.5,
        StopReason.MARGIN,
        Outcome.UNKNOWN if answer is None else Outcome.FOUND,
        () if answer is None else (answer,),
        yaw_set_deg=(yaw_deg,),
        min_score=min_score,
        min_margin=0.05,
    )


def searching_densely(
    answer: str | None = "mug-star", rotations_deg: Sequence[float] = (80.0, -115.0)
) -> Iterator[Event]:
    """Yield a dense search with these rotations, which distinguish the first two of `NAMES` best."""
    rng = np.random.default_rng(6)
    yield Started("identify", None, 8, {}, strategy="dense", descriptor=BENCH_DESCRIPTOR, notes=(NOTE,))
    possible_deg = tuple(float(rotation) for rotation in range(-175, 185, 5) if rotation)
    orientation_deg = 0.0
    for k in range(len(rotations_deg) + 1):
        rotation_deg = rotations_deg[k - 1] if k else 0.0
        orientation_deg += rotation_deg
        yield moved(k, -orientation_deg, -rotation_deg)
        yield Accepted(k, float(wrap360(orientation_deg)), evidence(), noise(rng, (48, 64)), {"agreement": 0.9})
        pose_deg = float(wrap360(orientation_deg - 30))
        probability = (0.6 + 0.15 * k, 0.3 - 0.15 * k, 0.0005, 0.0, 0.0)
        candidates = tuple(
            Candidate(n, 0.9 - 0.1 * i, pose_deg, p) for i, (n, p) in enumerate(zip(NAMES, probability, strict=True))
        )
        decision = StopDecision(Outcome.CONTINUE, StopReason.NOT_CONFIDENT, 0, probability[0], 0.0995, 0.95)
        yield Ranked(k, candidates, 0.1, decision)
        if k < len(rotations_deg):
            step_deg = rotations_deg[k]
            away = tuple(abs(float(wrap180(rotation - step_deg))) for rotation in possible_deg)
            weighed = Weighed(
                possible_deg,
                tuple(-8.0 + a / 30 for a in away),
                tuple(0.02 + abs(rotation) / 4500 for rotation in possible_deg),
                tuple(0.5 + a / 400 for a in away),
            )
            reason = RotationReason.SEPARATES_CANDIDATES
            side, target_deg = "left" if step_deg >= 0 else "right", -orientation_deg - step_deg
            yield Decided(k, side, step_deg, target_deg, None, None, NAMES[:2], reason, weighed=weighed)
    yield Identified(
        answer,
        candidates,
        candidates[0].score,
        0.1,
        pose_deg,
        30.0,
        k + 1,
        195.0,
        7.5,
        StopReason.CONFIDENT,
        Outcome.UNKNOWN if answer is None else Outcome.FOUND,
        () if answer is None else (answer,),
        yaw_sigma_deg=2.0,
        yaw_set_deg=(30.0,),
        period_deg=360.0,
        confidence=None if answer is None else probability[0],
        min_confidence=0.95,
        not_enrolled=0.0995,
    )


def recorded(record: Record, events: Iterable[Event]) -> Record:
    for event in events:
        record.add(event)
    return record


def enrolled(*args: object, **kwargs: object) -> Record:
    return recorded(Record(TILE), enrolling(*args, **kwargs))  # type: ignore[arg-type]


def identified(*args: object, truth: Truth | None = None, **kwargs: object) -> Record:
    return recorded(Record(truth=truth), identifying(*args, **kwargs))  # type: ignore[arg-type]


def ambiguous(truth: Truth) -> Record:
    """Return a search for one of two objects; as always, the answer's name is that of the leading candidate."""
    record = identified("mug-white", (90.0,), truth=truth)
    assert record.answer is not None
    record.add(replace(record.answer, outcome=Outcome.AMBIGUOUS, possible=("mug-white", "mug-star")))
    return record
