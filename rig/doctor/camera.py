"""Check the camera: its mode, its locks, and the age and quality of its frames."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.bench.hardware import camera_settings, store_focus
from rig.core.clock import seconds_between
from rig.core.next_steps import Do, SomeSteps
from rig.devices.opencv_camera import NO_CONTROL, OpenCvCamera
from rig.devices.v4l2 import choose_mode
from rig.doctor.examination import DoctorContext
from rig.doctor.finding import Finding, bad, fine, warning
from rig.safety.saved_state import FileStore
from rig.views.capture import ImageQuality, rejection_text

LOCKABLE = (
    *("exposure_us", "white_balance_k", "gain", "focus", "sharpness"),
    *("backlight_compensation", "power_line_frequency"),
)
"""Settings that a camera reports, by their keys in ``[camera]``."""
QUICK, SPACED, SPACING_S = 5, 6, 0.17
"""Consecutive frames, which show the frame rate, and frames spread over a second, which show flicker."""
MAX_AGE_S = 0.25
"""Largest time from the start of an exposure until the program has the frame; the table waits for it at each view."""
STRIPS = 24  # a readout of 67 ms, a long one, shows 8 bands of a lamp at 60 Hz mains: three strips show each
MAX_FLICKER = 0.05  # largest spread of the level of a strip in frames of one scene


def camera(context: DoctorContext) -> Iterator[Finding]:
    """Open the camera, lock its settings, and take some frames."""
    with closing(open_camera(context)) as source:
        identity = source.identity
        context.identities["camera"] = asdict(identity)
        mode = {"name": identity.name, "width": identity.width, "height": identity.height, "fps": identity.fps}
        yield fine("camera", "{name}: {width}x{height} at {fps:.3g} frames/s", **mode)
        yield fine("time_base", "frames timed by {time_base} exposure", time_base=source.time_base.value)
        yield from _mode(context, source)
        yield from _locks(context, source)
        yield from _frames(context, source)


def open_camera(context: DoctorContext, *, refocus: bool = False) -> OpenCvCamera:
    """Open the camera with its settings, without the other devices.

    With ``refocus`` the autofocus finds a new position, which is stored for later programs.

    Raises `DeviceNotFound`, `DeviceSilent`: the camera is missing, or delivers no frames.
    """
    source = context.config.camera.source
    capture = context.computer.open_capture(source)
    device = context.computer.camera_device(source)
    state = FileStore(context.config.state_path(context.bench))
    settings = camera_settings(context.config, state, device)
    try:
        if refocus:
            settings = settings.model_copy(update={"focus": None})
            capture.set(cv2.CAP_PROP_AUTOFOCUS, 1)
        name, clock = f"camera {source}", context.computer.clock
        camera = OpenCvCamera(capture, clock=clock, settings=settings, name=name, device=device)
        if refocus:
            store_focus(state, device, camera.read_locks().focus)
    except BaseException:
        capture.release()
        raise
    return camera


def _mode(context: DoctorContext, source: OpenCvCamera) -> Iterator[Finding]:
    wanted = context.config.camera
    text = "the camera does not offer {wanted}; nearest: {nearest}"
    size = f"{wanted.width}x{wanted.height} at {wanted.fps:.3g} frames/s"
    nearest = choose_mode(source.modes, wanted.width, wanted.height, wanted.fps, wanted.fourcc)
    if nearest is None:
        usable = choose_mode(source.modes, wanted.width, wanted.height, wanted.fps)
        if usable is not None:
            fix = Do.SET_KEY(key="camera.fourcc", value="none")
            yield warning("mode_not_offered", text, fix, wanted=f"{size} ({wanted.fourcc})", nearest=usable)
    elif (nearest.width, nearest.height) != (wanted.width, wanted.height) or 0 < nearest.fps < 0.9 * wanted.fps:
        yield warning("mode_not_offered", text, Do.SETUP(), wanted=size, nearest=nearest)


def _locks(context: DoctorContext, source: OpenCvCamera) -> Iterator[Finding]:
    locks = source.read_locks()
    fix = f"v4l2-ctl --list-ctrls-menus -d {context.config.camera.source}"
    rejected = []
    for one in source.rejected_settings:
        # The driver requests the exposure in units of 100 µs.
        rejected.append("exposure_us" if one.setting == "exposure_100us" else one.setting)
        found = {"setting": one.setting, "requested": one.asked, "reported": one.reported}
        steps: SomeSteps = fix
        if one.reported == NO_CONTROL:
            steps = (
                "Views of one object differ if the light changes: keep it constant, or use a camera with this control.",
                Do.SET_KEY(key=f"camera.{rejected[-1]}", value="none"),
            )
        yield warning(
            "setting_rejected", "{setting}: requested {requested}, the camera reports {reported}", steps, **found
        )
    is_loose = {
        "exposure_us": locks.auto_exposure,
        "white_balance_k": locks.auto_white_balance,
        "gain": locks.gain is not None and context.config.camera.gain is None,
        "focus": locks.autofocus,
        "frame rate": locks.dynamic_frame_rate,
    }
    not_locked = [name for name, loose in is_loose.items() if loose]
    if not_locked:
        text = "{settings} not locked: views of one object may differ"
        yield warning("not_locked", text, fix, settings=not_locked)
    known = {name: getattr(locks, name) for name in LOCKABLE if name not in (*not_locked, *rejected)}
    if locked := [f"{name} {value:.10g}" for name, value in known.items() if value is not None]:
        yield fine("locked", "locked and read back: {settings}", settings=locked)


def _frames(context: DoctorContext, source: OpenCvCamera) -> Iterator[Finding]:
    clock = context.computer.clock
    frames: list[NDArray[np.uint8]] = []
    ages = []
    # First frames as fast as they come, for the rate; then frames apart, for changes of the light.
    after_ns = start_ns = clock.now_ns()
    rate = 0.0
    for number in range(QUICK + SPACED):
        frame = source.capture(after_ns)
        ages.append(seconds_between(frame.exposed_ns, clock.now_ns()))
        frames.append(frame.image_bgr)
        if number == QUICK - 1:
            rate = QUICK / max(seconds_between(start_ns, clock.now_ns()), 1e-9)
        after_ns = frame.exposed_ns + (1 if number < QUICK else round(SPACING_S * 1e9))
    # A black or frozen camera explains all other findings, so it is the only one.
    seen = [ImageQuality.of(frame, context.config.view) for frame in frames]
    levels = [each.mean_level for each in seen]
    evidence: dict[str, Any] = {"frame_age_ms": 1e3 * max(ages), "frames_per_s": rate, "mean_levels": levels}
    if max(levels) < context.config.view.min_mean:
        fix: SomeSteps = "Take the lens cap off and switch the light on"
        yield bad("black", "black: mean level {mean_level:.1f} of 255", fix, mean_level=max(levels), **evidence)
        return
    if all(np.array_equal(frames[0], frame) for frame in frames[1:]):
        fix = "Unplug the camera, plug it in again"
        yield bad("camera_frozen", "frozen: {frames} frames are identical", fix, frames=len(frames), **evidence)
        return
    text = "frames arrive {frame_age_ms:.0f} ms after exposure, {frames_per_s:.3g} a second"
    if max(ages) > MAX_AGE_S:
        yield warning("late_frames", f"{text}: too old", "Try another USB port, or reduce camera.width", **evidence)
    elif rate < 0.6 * source.identity.fps:
        fix = "Try another USB port, or reduce camera.exposure_us or camera.fps"
        yield warning("few_frames", f"{text}, not {{fps:.3g}}", fix, fps=source.identity.fps, **evidence)
    else:
        yield fine("frames", text, **evidence)
    # A rolling shutter shows a lamp at the mains as bands that move from image to image, so each strip counts alone.
    strips = np.array([[part.mean() for part in np.array_split(frame, STRIPS)] for frame in frames])
    spread = float(np.ptp(strips, axis=0).max() / strips.mean())
    if spread > MAX_FLICKER:
        text = "the light changes by {spread:.0%} within {seconds:.0f} s"
        fix = (
            "Lamps flicker with the mains: set camera.exposure_us to whole periods of the lamp, 10000 at 50 Hz or 8333 "
            "at 60 Hz. Keep daylight and shadows away"
        )
        yield warning("flicker", text, fix, spread=spread, seconds=SPACED * SPACING_S, **evidence)
    # Would an enrollment accept this view?
    quality = asdict(seen[-1])
    if reasons := seen[-1].reasons(context.config.view):
        texts = [rejection_text(reason, seen[-1]) for reason in reasons]
        fix = (
            "Check light, exposure and focus (an empty table may look blurred). The limits are in [view].",
            Do.SHOW_CONFIGURATION(),
        )
        text = "a view would be rejected now: {reasons}"
        yield warning("view_rejected", text, fix, reasons=texts, codes=reasons, **quality)
    else:
        text = (
            "a view would be accepted now: mean level {mean_level:.0f}, sharpness {sharpness:.0f}, "
            "{saturated_share:.1%} saturated"
        )
        yield fine("view_accepted", text, **quality)
