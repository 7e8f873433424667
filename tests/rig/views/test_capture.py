"""Acceptance of frames as views, with the simulated camera behind the real driver."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.config import CameraTimeConfig, ViewConfig
from rig.motion.turntable import Turntable
from rig.views.capture import (
    DARK_LEVEL,
    NOISE_GAIN,
    Attempt,
    ImageQuality,
    MotionEvidence,
    RejectReason,
    Viewer,
    rejection_text,
)
from tests.rig.bench_parts import at_rest


def attempts_of(simulated, table, viewer) -> list[Attempt]:
    return list(viewer.attempts(simulated.bench.clock.now_ns(), table.check_still))


@pytest.fixture
def on_the_table(simulated):
    s = simulated("view.min_sharpness=60")
    s.operator.place("mug-dots")
    with Turntable(s.bench) as table:
        yield s, table, Viewer(s.bench.camera, s.bench.config)


def test_good_frame_shows_the_table_after_it_came_to_rest(on_the_table):
    """Stale buffers of the camera, exposed during the motion, must not become views."""
    s, table, viewer = on_the_table
    move = table.goto(40.0)
    (attempt,) = viewer.attempts(move.settled_ns, table.check_still)
    assert attempt.accepted
    assert attempt.number == 1
    assert attempt.image_bgr.shape == (240, 320, 3)
    assert attempt.evidence.locks_hold
    assert attempt.evidence.stillness.still
    assert attempt.evidence.exposed_ns >= move.settled_ns
    assert s.world.table_deg(attempt.evidence.exposed_ns) == at_rest(s.operator.devices.servo, 40.0)


def test_delay_inside_the_camera_is_waited_for(on_the_table):
    """Its time stamps do not show it; `rig calibrate camera-time` has measured it."""
    s, table, _ = on_the_table
    camera = s.operator.devices.camera
    camera.times.offset_ns, camera.times.readout_ns = 200_000_000, 10_000_000
    settled_ns = s.bench.clock.now_ns()
    for known, early in ((False, True), (True, False)):
        time = CameraTimeConfig(offset_ms=-200 + (10 + 10) / 2, readout_ms=10) if known else CameraTimeConfig()
        viewer = Viewer(s.bench.camera, s.bench.config.model_copy(update={"camera_time": time}))
        settled_ns = s.bench.clock.now_ns()
        (attempt,) = viewer.attempts(settled_ns, table.check_still)
        assert (attempt.evidence.exposed_ns - camera.times.offset_ns < settled_ns - 2_000_000) is early


def light_up(simulated, light) -> None:
    """Change the light, for all frames from now on: an exposure may begin some milliseconds before its stamp."""
    simulated.world.change(light=(light,) * 3)
    simulated.world.clock.sleep(0.02)


def test_darkness_is_rejected_until_the_retakes_are_used_up(on_the_table):
    s, table, viewer = on_the_table
    light_up(s, 0.0)
    attempts = attempts_of(s, table, viewer)
    assert [a.number for a in attempts] == [1, 2, 3, 4]
    assert all(RejectReason.TOO_DARK in a.reasons for a in attempts)
    assert rejection_text(RejectReason.TOO_DARK, attempts[0].evidence) == "too dark (mean level 0.1, 100 % black)"


def test_short_darkness_costs_one_retake(on_the_table):
    s, table, viewer = on_the_table
    light_up(s, 0.0)
    s.world.clock.call_at(s.bench.clock.now_ns() + 60_000_000, lambda: s.world.change(light=(1.0, 1.0, 1.0)))
    attempts = attempts_of(s, table, viewer)
    assert attempts[-1].accepted
    assert 1 < len(attempts) <= 4


@pytest.mark.parametrize("repeated", [5, 10, 40])
def test_frames_that_the_camera_repeats_are_not_retakes(on_the_table, repeated):
    s, table, viewer = on_the_table
    sent = []

    def again(image, _frame):
        sent.append(image)
        return sent[0] if len(sent) <= repeated + 1 else image

    s.operator.devices.camera.filters.append(again)
    attempts = attempts_of(s, table, viewer)
    assert attempts[0].accepted  # it is new
    attempts = attempts_of(s, table, viewer)
    assert all(attempt.reasons == (RejectReason.REPEATED_FRAME,) for attempt in attempts[:-1])
    if repeated <= 10:
        assert len(attempts) == repeated + 1
        assert attempts[-1].accepted
    else:
        assert len(attempts) == 10 + 1 + s.bench.config.view.retakes
        assert not attempts[-1].accepted


def move_on(s) -> None:
    s.bench.servo.move_to(s.bench.servo.read_state().position_deg + 60)
    s.world.clock.sleep(0.3)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda s: light_up(s, 30.0), RejectReason.OVEREXPOSED),
        # another program changed a setting
        (lambda s: s.bench.camera._capture.set(cv2.CAP_PROP_EXPOSURE, 40), RejectReason.LOCKS_CHANGED),
        (move_on, RejectReason.TABLE_MOVED),
        (lambda s: s.bench.camera._capture.set(cv2.CAP_PROP_FOCUS, 250), RejectReason.BLURRED),
    ],
)
def test_spoilt_frame_is_rejected_with_its_reason(on_the_table, spoil, reason):
    s, table, viewer = on_the_table
    spoil(s)
    assert reason in attempts_of(s, table, viewer)[0].reasons


def test_frozen_camera_is_rejected(on_the_table, monkeypatch):
    s, table, viewer = on_the_table
    assert attempts_of(s, table, viewer)[-1].accepted
    capture = s.bench.camera._capture
    frozen = capture.retrieve()
    monkeypatch.setattr(capture, "retrieve", lambda *_: frozen)
    attempts_of(s, table, viewer)
    assert RejectReason.REPEATED_FRAME in attempts_of(s, table, viewer)[0].reasons


def test_platter_pushed_after_settling_gives_no_view(on_the_table):
    s, table, viewer = on_the_table
    settled_ns = table.goto(40.0).settled_ns
    s.world.slip(3.0, 0.02)
    attempts = list(viewer.attempts(settled_ns, table.check_still))
    assert not attempts[-1].accepted
    assert attempts[-1].reasons == (RejectReason.TABLE_MOVED,)
    assert "platter +" in rejection_text(attempts[-1].reasons[0], attempts[-1].evidence)
    assert attempts[-1].evidence.stillness.platter_change_deg == pytest.approx(3.0, abs=0.1)


def test_view_is_accepted_after_a_pause_longer_than_the_gyro_fifo(on_the_table):
    """A consumer of events may pause; the samples that the gyro lost meanwhile are not a motion."""
    s, table, viewer = on_the_table
    settled_ns = table.goto(40.0).settled_ns
    s.world.clock.sleep(30.0)
    attempts = list(viewer.attempts(settled_ns, table.check_still))
    assert attempts[0].reasons == (RejectReason.GYRO_INCOMPLETE,)
    assert attempts[-1].accepted


def test_every_reason_has_a_text_and_old_texts_stay(on_the_table):
    in_motion = MotionEvidence(0, angle_deg=40.0, angle_sigma_deg=0.3, speed_dps=60.0, smear_px=3.0, residual_deg=0.1)
    evidence = replace(attempts_of(*on_the_table)[0].evidence, motion=in_motion)
    assert {*RejectReason, ""}.isdisjoint(rejection_text(reason, evidence) for reason in RejectReason)
    assert rejection_text("blurred (sharpness 2.0 < 3)", evidence) == "blurred (sharpness 2.0 < 3)"


@given(st.integers(0, 2**32 - 1), st.integers(2, 24), st.integers(2, 24), st.integers(0, 255), st.integers(0, 255))
def test_image_quality_is_that_of_its_definition(seed, height, width, low, high):
    low, high = sorted((low, high))
    image = np.random.default_rng(seed).integers(low, high + 1, (height, width, 3)).astype(np.uint8)
    quality = ImageQuality.of(image, ViewConfig(roi=None))
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(float)
    sharpness = cv2.Laplacian(grey, cv2.CV_64F).var()
    assert quality.sharpness == pytest.approx(sharpness, rel=1e-12, abs=1e-9)
    assert quality.mean_level == pytest.approx(grey.mean(), rel=1e-14)
    assert quality.dark_share == (grey < DARK_LEVEL).mean()
    assert quality.saturated_share == (grey == 255).mean()
    assert quality.noise_share == pytest.approx(sharpness / (NOISE_GAIN * max(grey.var(), 1.0)), rel=1e-12, abs=1e-9)
