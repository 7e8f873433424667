"""Which frames are taken as views, on the simulated camera behind the real driver."""

import pytest

from rig.motion.turntable import Turntable
from rig.views.capture import Attempt, Viewer
from rig.views.description import ViewDescriber


def look(simulated, table, viewer) -> list[Attempt]:
    return list(viewer.attempts(simulated.bench.clock.now_ns(), table.check_still))


@pytest.fixture
def on_the_table(simulated):
    s = simulated()
    s.operator.place("mug-dots")
    with Turntable(s.bench) as table:
        yield s, table, Viewer(s.bench.camera, s.bench.config.view)


def test_a_good_frame_is_taken_at_once_with_its_evidence(on_the_table):
    _, table, viewer = on_the_table
    settled_ns = table.hold().settled_ns
    (attempt,) = viewer.attempts(settled_ns, table.check_still)
    assert attempt.accepted
    assert attempt.number == 1
    assert attempt.evidence.exposed_ns >= settled_ns
    assert attempt.evidence.locks_hold
    assert attempt.evidence.stillness.still
    assert attempt.image_bgr.shape == (480, 640, 3)


def test_the_frame_shows_the_table_after_it_came_to_rest(on_the_table):
    """Stale buffers of the camera, exposed during the motion, must not become views."""
    s, table, viewer = on_the_table
    move = table.goto(40.0)
    (attempt,) = viewer.attempts(move.settled_ns, table.check_still)
    assert attempt.evidence.exposed_ns >= move.settled_ns
    assert s.world.table_deg(attempt.evidence.exposed_ns) == pytest.approx(40.0, abs=0.3)


def test_darkness_is_refused_until_the_retakes_are_used_up(on_the_table):
    s, table, viewer = on_the_table
    s.world.change(light=(0.0, 0.0, 0.0))
    attempts = look(s, table, viewer)
    assert [a.number for a in attempts] == [1, 2, 3, 4]
    assert all(any(reason.startswith("too dark") for reason in a.reasons) for a in attempts)


def test_a_flash_of_darkness_costs_one_retake(on_the_table):
    s, table, viewer = on_the_table
    s.world.change(light=(0.0, 0.0, 0.0))
    s.world.clock.call_at(s.bench.clock.now_ns() + 60_000_000, lambda: s.world.change(light=(1.0, 1.0, 1.0)))
    attempts = look(s, table, viewer)
    assert attempts[-1].accepted
    assert 1 < len(attempts) <= 4


def test_glare_is_refused(on_the_table):
    s, table, viewer = on_the_table
    s.world.change(light=(30.0, 30.0, 30.0))
    assert any(reason.startswith("overexposed") for reason in look(s, table, viewer)[0].reasons)


def test_a_camera_whose_locks_have_moved_is_refused(on_the_table):
    import cv2

    s, table, viewer = on_the_table
    s.bench.camera._capture.set(cv2.CAP_PROP_EXPOSURE, 40)  # somebody's other program turned a knob
    assert "exposure or white balance is not as locked" in look(s, table, viewer)[0].reasons


def test_a_frozen_camera_is_refused(on_the_table, monkeypatch):
    s, table, viewer = on_the_table
    assert look(s, table, viewer)[-1].accepted
    capture = s.bench.camera._capture
    frozen = capture.retrieve()
    monkeypatch.setattr(capture, "retrieve", lambda *_: frozen)
    look(s, table, viewer)
    assert "the camera repeated its last frame" in look(s, table, viewer)[0].reasons


def test_a_table_that_moves_during_the_exposure_is_refused(on_the_table):
    s, table, viewer = on_the_table
    s.bench.servo.move_to(s.bench.servo.read_state().position_deg + 60)
    s.world.clock.sleep(0.3)
    assert any(reason.startswith("the table moved") for reason in look(s, table, viewer)[0].reasons)


def test_a_frame_out_of_focus_is_refused(simulated):
    s = simulated("camera.focus=250", "view.min_sharpness=60")
    s.operator.place("mug-dots")
    with Turntable(s.bench) as table:
        attempts = look(s, table, Viewer(s.bench.camera, s.bench.config.view))
    assert any(reason.startswith("blurred") for reason in attempts[0].reasons)


def test_the_region_of_interest_is_what_is_described(on_the_table):
    import hbr

    s, table, viewer = on_the_table
    (attempt,) = look(s, table, viewer)
    x, y, width, height = s.bench.config.view.roi
    levels = ViewDescriber(s.bench.config.view)(attempt.image_bgr).levels["cedd"]
    assert (levels == hbr.describe(attempt.image_bgr[y : y + height, x : x + width])).all()


def test_a_platter_pushed_after_settling_gives_no_view_however_often_it_is_retaken(on_the_table):
    s, table, viewer = on_the_table
    settled_ns = table.goto(40.0).settled_ns
    s.world.slip(3.0, 0.02)
    attempts = list(viewer.attempts(settled_ns, table.check_still))
    assert not attempts[-1].accepted
    assert "platter +" in attempts[-1].reasons[0]
    assert attempts[-1].evidence.stillness.platter_change_deg == pytest.approx(3.0, abs=0.1)


def test_after_a_pause_longer_than_the_gyros_memory_a_view_is_still_taken(on_the_table):
    """Whoever consumes a plan's events may stop for a while; what the gyro missed meanwhile is not called a motion."""
    s, table, viewer = on_the_table
    settled_ns = table.goto(40.0).settled_ns
    s.world.clock.sleep(30.0)
    attempts = list(viewer.attempts(settled_ns, table.check_still))
    assert "unknown" in attempts[0].reasons[0]
    assert attempts[-1].accepted
