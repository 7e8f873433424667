"""Enrollment in motion: true angles, complete enrollments, and no view with a wrong angle."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rig import Catalog, enroll
from rig.bench import Bench
from rig.config import load_config
from rig.core.errors import (
    CatalogError,
    DeviceSilent,
    LimitExceeded,
    ObjectMoved,
    RigError,
    RotationDisagreement,
    UsageError,
)
from rig.core.next_steps import Do
from rig.devices.camera import Frame
from rig.events.events import Accepted, Enrolled, Event, ScanStarted
from rig.events.wording import line
from rig.motion.flight_views import FlightFrames, irregular_stamps
from rig.motion.move import MotionTimes
from rig.motion.scan_speed import SpeedLimit, scan_speed, takes_in_motion
from rig.motion.turntable import Turntable
from rig.plans.enroll import retake
from rig.plans.tray import TrayItem, enroll_tray
from rig.safety.saved_state import StateStore
from rig.views.capture import RejectReason
from rig.views.stream import FrameStream, after_middle_row_ns, middle_ns
from sim.bench import ShelfOperator, open_sim_bench
from sim.faults import Fault
from sim.noise import NoiseModel
from sim.objects.polyhedron import box
from sim.objects.solid import Solid
from sim.world import World
from tests.rig.motion.times import SMALL, camera_time, no_frame

WHITE = (200, 200, 200)

BLOCK = Solid("block", (box((60, 40, 50), ((30, 30, 220), (40, 200, 40), (220, 60, 30), (30, 200, 220)), top=WHITE),))
"""An object without print, so that the many frames of a revolution are drawn fast."""
FAST = ("table.velocity_dps=200", "view.max_smear_px=9")


@contextmanager
def flying(
    folder: Path,
    *settings: str,
    seed: int = 4,
    faults: tuple[str, ...] = (),
    state: StateStore | None = None,
    **noise: float,
) -> Iterator[tuple[Bench, Catalog, World]]:
    world = World(seed=seed, noise=NoiseModel(**noise))
    config = camera_time(world, *SMALL, *settings)
    operator = ShelfOperator(world, {"block": BLOCK, "lamp": BLOCK})
    operator.state = state or operator.state
    with (
        open_sim_bench(config, operator, faults=[Fault.parse(one) for one in faults]) as bench,
        Catalog.open(folder / "catalog", clock=bench.clock) as catalog,
    ):
        yield bench, catalog, world


def true_errors(events: list[Event], bench: Bench, world: World) -> np.ndarray[Any, Any]:
    """Return the errors of the angles of views in motion that the world still remembers."""
    times, found = bench.placer.devices.camera.times, []  # type: ignore[attr-defined]
    for event in events:
        if isinstance(event, Accepted) and (motion := event.evidence.motion) is not None:
            middle_ns = event.evidence.exposed_ns - times.offset_ns + times.readout_ns // 2 + 5_000_000
            found.append(motion.angle_deg - world.table_deg(middle_ns) - world.noise.backlash_deg / 2)
    return np.array(found)


def test_one_revolution_enrolls_all_views_at_their_true_angles(tmp_path: Path) -> None:
    with flying(tmp_path, lost_frames=0.02, usb_latency_ms=1.0) as (bench, catalog, world):
        events: list[Event] = []
        errors = None
        for event in enroll(bench, catalog, "block", views=24, fly=True):
            events.append(event)
            if isinstance(event, Accepted) and event.evidence.motion is not None:
                more = true_errors([event], bench, world)
                errors = more if errors is None else np.append(errors, more)
        assert errors is not None
        assert np.abs(errors).max() < 0.2
        done = events[-1]
        assert isinstance(done, Enrolled)
        assert done.seconds < 14
        assert MotionTimes(bench.config).enrollment_s(0.0, [0.0], in_motion=True) == pytest.approx(
            done.seconds, rel=0.15
        )
        stored = catalog.object("block").views
        planned = -15.0 * np.arange(24) % 360
        azimuths = np.array([view.azimuth_deg for view in stored])
        assert np.abs((azimuths - planned + 180) % 360 - 180).max() < 4.0
        moving = [view.evidence for view in stored if view.evidence["motion"]]
        assert len(moving) >= 22
        for evidence in moving:
            assert set(evidence["motion"]) >= {"middle_ns", "angle_deg", "angle_sigma_deg", "speed_dps", "smear_px"}
        started = next(event for event in events if isinstance(event, ScanStarted))
        assert "allows" in line(started)
        assert abs(bench.servo.read_state().velocity_dps) < 1
        assert not bench.servo.read_condition().torque
        with pytest.raises(CatalogError, match="taken in motion"):
            next(retake(bench, catalog, "block", [3]))


def test_rolling_shutter_exposes_the_rows_of_the_object_later() -> None:
    config = load_config(None, (*SMALL, "view.roi=[40, 30, 240, 200]", "camera_time.readout_ms=12"))
    assert after_middle_row_ns(config, (10, 90, 20, 60)) == 1_500_000  # row 150 of 240
    assert after_middle_row_ns(config, (10, 60, 20, 60)) == 0


@pytest.mark.parametrize(
    ("settings", "limit", "words"),
    [
        (("view.max_smear_px=0.8",), SpeedLimit.SMEAR, "10 ms exposure allows 38 °/s"),
        ((), SpeedLimit.TABLE, "table.velocity_dps allows 90 °/s"),
        (FAST, SpeedLimit.FRAME_RATE, "30 frames/s allow 135 °/s"),
        (("camera_time.jitter_ms=5",), SpeedLimit.TIME, "uncertain by 5.0 ms"),
        (("view.max_angle_sigma_deg=0.06",), SpeedLimit.TIME, "uncertain by 0.4 ms allow 85 °/s"),
    ],
)
def test_speed_is_the_fastest_that_the_limits_allow(settings: tuple[str, ...], limit: SpeedLimit, words: str) -> None:
    speed = scan_speed(camera_time(World(), *SMALL, *settings), 250.0, 360 / 72, 30.0)
    assert speed.limit is limit
    assert words in line(ScanStarted(speed.dps, speed.limit, speed.value, 0.0, 360.0))


def test_trays_fly_if_the_camera_time_is_calibrated_and_single_objects_if_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[bool | None] = []
    monkeypatch.setattr("rig.plans.tray.enroll", lambda *_, fly, **__: asked.append(fly) or iter(()))
    with flying(tmp_path) as (bench, catalog, _):
        list(enroll_tray(bench, catalog, [TrayItem(2, "block")]))
    assert asked == [True]
    calibrated, unknown = camera_time(World(), *SMALL), load_config(None, SMALL)
    assert [takes_in_motion(one, None, tray=True) for one in (calibrated, unknown)] == [True, False]
    assert [takes_in_motion(calibrated, fly) for fly in (None, True)] == [False, True]


def test_frames_without_a_sure_angle_are_rejected(tmp_path: Path) -> None:
    with flying(tmp_path) as (bench, _, _), Turntable(bench) as table:
        frames = FlightFrames(bench, table)
        taken: list[Frame] = []
        table.fly(60.0, frames.flight(taken.append, (0.0, 60.0), 45.0))
        trajectory, locks = frames.recorder.fit(), bench.camera.read_locks()
        assert trajectory is not None
        frame = taken[len(taken) // 2]
        late = replace(frame, exposed_ns=trajectory.end_ns + 500_000_000)  # nothing was measured then
        slipped = replace(trajectory, residual_deg=1.0)
        assert RejectReason.ANGLE_UNCERTAIN not in frames.attempt(frame, trajectory, locks).reasons
        assert RejectReason.ANGLE_UNCERTAIN in frames.attempt(late, trajectory, locks).reasons
        assert RejectReason.ANGLE_UNCERTAIN in frames.attempt(frame, slipped, locks).reasons


def test_approximate_angle_of_a_frame_lies_between_its_readings_or_after_the_last(tmp_path: Path) -> None:
    with flying(tmp_path) as (bench, _, _), Turntable(bench) as table:
        frames = FlightFrames(bench, table)
        frame = frames.stream.next(table.collect_gyro)
        assert frame is not None
        time_ns = middle_ns(frame.exposed_ns, bench.config.camera_time)
        for ms, angle_deg in ((-300, 0.0), (-100, 10.0)):
            frames.recorder.add_reading(time_ns + ms * 1_000_000, angle_deg)
        assert frames.about_deg(frame) == pytest.approx(15.0)
        for ms, angle_deg in ((100, 30.0), (200, 30.0)):
            frames.recorder.add_reading(time_ns + ms * 1_000_000, angle_deg)
        assert frames.about_deg(frame) == pytest.approx(20.0)


def outcome(tmp_path: Path, *faults: str) -> tuple[RigError | None, list[Event], float]:
    """Return the error of an enrollment under faults, its events, and the largest error of a stored angle."""
    events: list[Event] = []
    error, worst = None, 0.0
    with suppress(DeviceSilent), flying(tmp_path, faults=faults, camera_readout_ms=0.0) as (bench, catalog, world):
        try:
            for event in enroll(bench, catalog, "block", views=12, fly=True):
                events.append(event)
                worst = max([worst, *np.abs(true_errors([event], bench, world))])
        except RigError as failure:
            error = failure
        happened = {one.fault.kind.name for one in bench.placer.faults.history}  # type: ignore[attr-defined]
        assert happened == {Fault.parse(one).kind.name for one in faults}
        if "unplug" not in happened:
            assert not bench.servo.read_condition().torque
    return error, events, worst


MISSING = ("lost_frames:rate=0.4", "doubled_frame", "frozen_frame")
MISTIMED = ("stamp_jump:ms=15", "stamps_backwards", "stamp_jitter")
UNRELIABLE = ("camera.slow:fps=10", "camera.intermittent")
ABSENT = ("camera.stuck", "camera.delayed", "camera.off")


@pytest.mark.nightly
@pytest.mark.parametrize("kinds", [MISTIMED, MISSING, UNRELIABLE, ABSENT])
def test_faulty_frames_leave_only_true_views(tmp_path: Path, kinds: tuple[str, ...]) -> None:
    error, events, worst = outcome(tmp_path, *(f"{kind}@{1.5 + 1.1 * i:.1f}s+0.8s" for i, kind in enumerate(kinds)))
    assert error is None
    assert isinstance(events[-1], Enrolled)  # complete: the missing views were taken at rest
    assert worst < 0.4


@pytest.mark.parametrize(
    ("fault", "kind"),
    [
        ("slip:angle=3@2s", RotationDisagreement),
        pytest.param("jam@2s", RigError, marks=pytest.mark.nightly),
        pytest.param("unplug@2s", RigError, marks=pytest.mark.nightly),
    ],
)
def test_failed_revolution_stores_no_view(tmp_path: Path, fault: str, kind: type[RigError]) -> None:
    error, events, _ = outcome(tmp_path, fault)
    assert isinstance(error, kind)
    assert not any(isinstance(event, Accepted) for event in events)


@pytest.mark.nightly
def test_interrupted_revolution_is_resumed_and_can_be_paused(tmp_path: Path) -> None:
    with flying(tmp_path, *FAST, camera_readout_ms=0.0) as (bench, catalog, _):
        events = enroll(bench, catalog, "block", views=8, fly=True)
        for event in events:
            if isinstance(event, Accepted):
                break
        events.close()
        assert not bench.servo.read_condition().torque
        for done in enroll(bench, catalog, "block", resume=True, fly=True):
            # The operator pauses before the revolution, and between its views.
            if isinstance(done, ScanStarted) or (isinstance(done, Accepted) and done.index in (1, 5)):
                assert abs(bench.servo.read_state().velocity_dps) < 1
                bench.clock.sleep(40.0)
        assert isinstance(done, Enrolled)
        assert len(catalog.object("block").views) == 8


@pytest.mark.nightly
def test_enrollment_in_motion_is_abandoned_if_the_object_moved(tmp_path: Path) -> None:
    with (
        flying(tmp_path, *FAST, camera_readout_ms=0.0, faults=("object_falls@2.5s",)) as (bench, catalog, _),
        pytest.raises(ObjectMoved),
    ):
        list(enroll(bench, catalog, "block", views=8, fly=True))


def test_scan_needs_camera_time_and_a_revolution_of_cable(tmp_path: Path) -> None:
    with flying(tmp_path, "table.mode=pan", "table.limits_deg=[-100, 100]") as (bench, catalog, _):
        with pytest.raises(LimitExceeded):
            list(enroll(bench, catalog, "block", views=8, fly=True))
        bench.config = bench.config.model_copy(
            update={"camera_time": bench.config.camera_time.model_copy(update={"offset_ms": None})}
        )
        with pytest.raises(UsageError, match="not calibrated") as caught:
            list(enroll(bench, catalog, "block", views=8, fly=True))
        assert Do.CALIBRATE(name="camera-time") in caught.value.steps
        assert not catalog.objects()


def test_views_of_a_revolution_without_any_frame_are_taken_at_rest(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(FrameStream, "next", no_frame)
    with flying(tmp_path, *FAST, camera_readout_ms=0.0) as (bench, catalog, _):
        events = list(enroll(bench, catalog, "block", views=4, fly=True))
        views = [event for event in events if isinstance(event, Accepted)]
        assert [view.evidence.motion for view in views] == [None] * 4
        assert len(catalog.object("block").views) == 4


@pytest.mark.parametrize("stamps_ns", [[], [7]])
def test_time_stamps_that_are_too_few_to_compare_are_regular(stamps_ns: list[int]) -> None:
    assert irregular_stamps(stamps_ns, 1 / 30, 0.2).tolist() == [False] * len(stamps_ns)
