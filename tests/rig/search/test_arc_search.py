"""Searches in motion: they end during the rotation, can be replayed, and use no faulty frame as evidence."""

import signal
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest

import hbr
from rig import Catalog, enroll, identify, load_model
from rig.bench import Bench
from rig.core.errors import MotionStopped, RigError, Stalled, UsageError
from rig.events.events import Accepted, Decided, FrameUsed, Identified, Moved, Ranked
from rig.report.report import run_report
from rig.search.model import Model
from rig.search.replay import check
from rig.search.saved_run import load_run, save_run
from sim.bench import ShelfOperator, open_sim_bench
from sim.faults import Fault
from sim.objects.shelf import shelf
from sim.world import World
from tests.rig.motion.times import SMALL, camera_time

NAMES = ("bottle-green", "bottle-harvest", "can-peach")


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Model]:
    """Return a model of three objects, two of them twins."""
    world = World(seed=5)
    with (
        open_sim_bench(camera_time(world, *SMALL), ShelfOperator(world, shelf())) as bench,
        Catalog.open(tmp_path_factory.mktemp("model"), clock=bench.clock) as catalog,
    ):
        for name in NAMES:
            list(enroll(bench, catalog, name, views=9))
        yield load_model(catalog)


def moving(world: World, *settings: str, faults: tuple[str, ...] = ()) -> Bench:
    operator = ShelfOperator(world, shelf(), next_object="bottle-harvest", yaw_deg=200.0)
    return open_sim_bench(camera_time(world, *SMALL, *settings), operator, faults=[Fault.parse(one) for one in faults])


def test_search_ends_during_the_rotation_and_can_be_replayed(model: Model, tmp_path: Path) -> None:
    live: list[FrameUsed] = []
    with moving(World(seed=2)) as bench, save_run(tmp_path / "run", bench, model) as save:
        events = []
        for event in identify(bench, model, live=live.append):
            save(event)
            events.append(event)
            if isinstance(event, Accepted) and event.evidence.motion is not None:
                assert live  # its event was reported during the rotation
        answer = events[-1]
        assert isinstance(answer, Identified)
        assert answer.name == "bottle-harvest"
        in_motion = [e for e in events if isinstance(e, Accepted) and e.evidence.motion is not None]
        assert len(in_motion) >= 3
        goal_deg = [e.target_deg for e in events if isinstance(e, Decided)][-1]
        stop_deg = next(e.encoder_deg for e in events if isinstance(e, Moved))
        assert abs(goal_deg - stop_deg) > 5  # the table did not go to the end of the arc
        assert answer.seconds < 3.5
        assert not bench.servo.read_condition().torque
    found = check(load_run(tmp_path / "run"))
    assert found.is_complete
    assert found.differences == []
    assert found.views == 1 + len(in_motion)
    assert live == [e for e in events if isinstance(e, FrameUsed)]
    assert [one.index for one in live] == [e.index for e in in_motion]
    assert live[-1].name == answer.name
    assert live[-1].outcome is hbr.Outcome.FOUND
    enough = next(one for one in live if one.outcome is not hbr.Outcome.CONTINUE)
    report = run_report(load_run(tmp_path / "run"))
    assert "rotation since the first view, °" in report
    assert f"enough for an answer from view {enough.index + 1} on: {enough.seconds:.1f} s after the start" in report
    decisions = [e.candidates[0].probability for e in events if isinstance(e, Ranked)]
    assert len(decisions) < 1 + len(in_motion)


@pytest.mark.parametrize(
    ("how", "kind"),
    [
        ("Ctrl+C", KeyboardInterrupt),
        pytest.param("rig stop", MotionStopped, marks=pytest.mark.nightly),
        ("jam", Stalled),
    ],
)
def test_stop_in_an_arc_after_a_pause_switches_the_torque_off_before_anything_else(
    model: Model, how: str, kind: type[BaseException], tmp_path: Path
) -> None:
    """The consumer of events may pause at each of them, so no event comes while the torque is on."""
    world = World(seed=2)
    angles_deg: list[float] = []
    frames: list[FrameUsed] = []
    late_events: list[bool] = []
    with moving(world, "table.limits_deg=[-30, 30]", "table.mode=pan") as bench:
        operator = bench.placer
        assert isinstance(operator, ShelfOperator)
        assert operator.devices is not None
        servo, store = operator.devices.servo, operator.state

        def stop_at_the_third_frame(frame: FrameUsed) -> None:
            frames.append(frame)
            if len(frames) == 3:
                {
                    "Ctrl+C": partial(signal.raise_signal, signal.SIGINT),
                    "rig stop": store.request_stop,
                    "jam": servo.jam,
                }[how]()

        def watch() -> None:
            angles_deg.append(world.table_deg())
            world.clock.call_at(world.clock.now_ns() + 10_000_000, watch)

        events = identify(bench, model, live=stop_at_the_third_frame)
        with pytest.raises(kind):
            for event in events:
                if isinstance(event, Decided) and not frames:
                    world.clock.sleep(20.0)  # the operator pauses before the arc
                    watch()
                    assert (servo.memory["Torque Enable"], servo.memory["Bus Watchdog"]) == (1, 0)
                elif len(frames) >= 3:
                    late_events.append(bool(servo.memory["Torque Enable"]))
        assert len(frames) >= 3
        assert not any(late_events)
        assert (servo.memory["Torque Enable"], servo.memory["Bus Watchdog"]) == (0, 0)
        rest_deg = world.table_deg()
        world.clock.sleep(1.0)
        assert world.table_deg() == pytest.approx(rest_deg, abs=0.05)
        assert -30.5 < min(angles_deg) < max(angles_deg) < 30.5
        stored = store.load()
        assert stored.table is not None
        assert stored.table.path_deg is None
        assert stored.table.position_deg == pytest.approx(servo.memory["Present Position"] * 360 / 4096, abs=0.1)
        assert not store.stop_requested()
        assert (stored.fault is not None) == (how == "jam")
        if how == "rig stop":
            *_, answer = identify(bench, model)
            assert isinstance(answer, Identified)


def test_guessed_view_does_not_end_the_search(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    reasons = []
    for reliable in (True, False):
        monkeypatch.setattr(hbr.ViewsTogether, "reliable", property(lambda _, now=reliable: now))
        with moving(World(seed=2)) as bench:
            bench.placer.next_object = "can-peach"  # type: ignore[attr-defined]
            events = identify(bench, model)
            first = next(event for event in events if isinstance(event, Ranked))
            events.close()
        assert first.decision is not None
        reasons.append(first.decision.reason)
    assert reasons == [hbr.StopReason.CONFIDENT, hbr.StopReason.BADLY_SEGMENTED]


def test_search_at_rest_stays_without_calibration_and_motion_asks_for_it(model: Model) -> None:
    with moving(World(seed=2), "identify.mode=step") as bench:
        events = list(identify(bench, model))
        assert all(e.evidence.motion is None for e in events if isinstance(e, Accepted))
        plain = bench.config.camera_time.model_copy(update={"offset_ms": None})
        bench.config = bench.config.model_copy(update={"camera_time": plain})
        with pytest.raises(UsageError, match="not calibrated"):
            list(identify(bench, model, strategy="arc"))


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("fault", "at_rest"),
    [("camera.stuck@0.8s+1.5s", 1), ("camera.off@0.8s+4s", 2)],
)
def test_table_continues_to_rotate_while_the_camera_delivers_nothing(model: Model, fault: str, at_rest: int) -> None:
    """Frames of the same arc end the search, or a view at rest where the arc has ended."""
    with moving(World(seed=2), faults=(fault,)) as bench:
        *events, answer = identify(bench, model)
        assert bench.placer.faults.history  # type: ignore[attr-defined]
        assert not bench.servo.read_condition().torque
    assert isinstance(answer, Identified)
    assert answer.name == "bottle-harvest"
    assert answer.seconds > 1.5
    assert sum(isinstance(e, Accepted) and e.evidence.motion is None for e in events) == at_rest


FAULTS = (
    "stamp_jump:ms=20@0.5s+0.1s",
    "stamps_backwards@0.7s+0.1s",
    "lost_frames:rate=0.6@0.9s+0.1s",
    "frozen_frame@1.1s",
)


@pytest.mark.parametrize("faults", [FAULTS, *(pytest.param((one,), marks=pytest.mark.nightly) for one in FAULTS)])
def test_faulty_frames_are_no_evidence(model: Model, faults: tuple[str, ...]) -> None:
    world = World(seed=2)
    with moving(world, faults=faults) as bench:
        times = bench.placer.devices.camera.times  # type: ignore[attr-defined]
        with suppress(RigError):
            for event in identify(bench, model):
                if isinstance(event, Accepted) and (motion := event.evidence.motion) is not None:
                    middle_ns = event.evidence.exposed_ns - times.offset_ns + times.readout_ns // 2 + 5_000_000
                    assert abs(motion.angle_deg - world.table_deg(middle_ns) - 0.125) < 0.6
        assert not bench.servo.read_condition().torque
        assert {one.fault.kind.name for one in bench.placer.faults.history} == {  # type: ignore[attr-defined]
            Fault.parse(one).kind.name for one in faults
        }
