"""Check the camera: its mode, its locks, and the age and quality of its frames."""

from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import asdict
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.bench.hardware import camera_settings, store_focus
from rig.core.clock import seconds_between
from rig.core.next_steps import Do, SomeSteps
from rig.devices.camera import CameraLocks
from rig.devices.opencv_camera import OpenCvCamera
from rig.devices.v4l2 import choose_mode
from rig.doctor.context import DoctorContext
from rig.doctor.finding import Finding, FindingCode, bad, fine, warning
from rig.doctor.flicker import (
    MainsFlicker,
    mains_flicker,
    standing_flicker,
    standing_mains_hz,
    steady_levels,
    whole_periods_us,
)
from rig.safety.saved_state import FileStore
from rig.views.capture import ImageQuality, rejection_text

_SETTINGS = {
    "exposure": "exposure_100us",
    "white balance": "white_balance_k",
    "gain": "gain",
    "focus": "focus",
    "sharpness": "sharpness",
    "backlight compensation": "backlight_compensation",
    "power-line frequency": "power_line_frequency",
    "frame rate": "dynamic_frame_rate",
}
"""The camera's setting for each name in words."""
_MAINS = {0.0: "off", 1.0: "50 Hz", 2.0: "60 Hz", 3.0: "automatic"}
"""Values of V4L2_CID_POWER_LINE_FREQUENCY (Linux, `v4l2-controls.h`)."""
_RATE = {True: "varies with the light", False: "constant"}
QUICK, SPACED, SPACING_S = 5, 6, 0.17
"""Consecutive frames, which show the frame rate, and frames spread over a second, which show flicker."""
MAX_AGE_S = 0.25
"""Largest time from the start of an exposure until the program has the frame; the table waits for it at each view."""
PER_EXPOSURE = 6
"""Images of each exposure time that are compared to find bands that stand still."""
DARK, BRIGHT = 12, 240
"""Levels between which a pixel shows the light."""
EXPOSURE_STEP_US = 100.0
"""Cameras round exposure times to this step."""
MAX_FLICKER = 0.05  # largest spread of the mean level of frames of one scene


def camera(context: DoctorContext) -> Iterator[Finding]:
    """Open the camera, lock its settings, and take some frames."""
    if context.holder is not None:
        yield warning("camera", FindingCode.NOT_CHECKED, Do.STOP())
        return
    with closing(open_camera(context)) as source:
        identity = source.identity
        context.identities["camera"] = {name: getattr(identity, name) for name in identity.__dataclass_fields__}
        mode = {"name": identity.name, "width": identity.width, "height": identity.height, "fps": identity.fps}
        yield fine("camera", FindingCode.CAMERA, **mode)
        yield fine("camera", FindingCode.TIME_BASE, time_base=source.time_base.value)
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
    with ExitStack() as failed:
        failed.callback(capture.release)
        if refocus:
            settings = settings.model_copy(update={"focus": None})
            capture.set(cv2.CAP_PROP_AUTOFOCUS, 1)
        camera = OpenCvCamera(
            capture,
            clock=context.computer.clock,
            settings=settings,
            name=f"camera {source}",
            device=device,
        )
        if refocus:
            store_focus(state, device, camera.read_locks().focus)
        failed.pop_all()
    return camera


def _mode(context: DoctorContext, source: OpenCvCamera) -> Iterator[Finding]:
    wanted = context.config.camera
    nearest = choose_mode(source.modes, wanted.width, wanted.height, wanted.fps, wanted.fourcc)
    if nearest is None:
        return
    if (nearest.width, nearest.height) != (wanted.width, wanted.height) or 0 < nearest.fps < 0.9 * wanted.fps:
        size = f"{wanted.width}x{wanted.height} at {wanted.fps:.3g} frames/s"
        yield warning("camera", FindingCode.MODE_NOT_OFFERED, Do.SETUP(), wanted=size, nearest=nearest)


def _locks(context: DoctorContext, source: OpenCvCamera) -> Iterator[Finding]:
    locks = source.read_locks()
    fix = f"v4l2-ctl --list-ctrls-menus -d {context.config.camera.source}"
    for one in source.rejected_settings:
        found = {"setting": one.setting, "requested": one.asked, "reported": one.reported}
        yield warning("camera", FindingCode.SETTING_REJECTED, fix, **found)
    wanted = context.config.camera
    not_locked = [
        name
        for name, loose in (
            ("exposure", locks.auto_exposure or (locks.exposure_us is None and wanted.exposure_us is not None)),
            (
                "white balance",
                locks.auto_white_balance or (locks.white_balance_k is None and wanted.white_balance_k is not None),
            ),
            ("gain", locks.gain is not None and wanted.gain is None),
            ("focus", locks.autofocus),
            ("frame rate", locks.dynamic_frame_rate),
        )
        if loose
    ]
    if not_locked:
        yield warning("camera", FindingCode.NOT_LOCKED, fix, settings=not_locked)
    rejected = {one.setting for one in source.rejected_settings}
    locked = [
        f"{name} {value}"
        for name, value in lock_words(locks).items()
        if name not in not_locked and _SETTINGS[name] not in rejected
    ]
    if locked:
        yield fine("camera", FindingCode.LOCKED, settings=locked)


def lock_words(locks: CameraLocks) -> dict[str, str]:
    """Return the settings that the camera reports, by name: "exposure": "10 ms"."""
    words = {
        "exposure": None if locks.exposure_us is None else f"{locks.exposure_us / 1e3:g} ms",
        "white balance": None if locks.white_balance_k is None else f"{locks.white_balance_k:g} K",
        "gain": _text(locks.gain),
        "focus": _text(locks.focus),
        "sharpness": _text(locks.sharpness),
        "backlight compensation": _text(locks.backlight_compensation),
        "power-line frequency": _mains(locks.power_line_frequency),
        "frame rate": None if locks.dynamic_frame_rate is None else _RATE[locks.dynamic_frame_rate],
    }
    return {name: value for name, value in words.items() if value is not None}


def _text(value: float | None) -> str | None:
    return None if value is None else f"{value:g}"


def _mains(value: float | None) -> str | None:
    return None if value is None else _MAINS.get(value, f"{value:g}")


def _frames(context: DoctorContext, source: OpenCvCamera) -> Iterator[Finding]:
    clock = context.computer.clock
    again = ("Unplug the camera, plug it in again, then", Do.DOCTOR())
    frames: list[NDArray[np.uint8]] = []
    times_ns = []
    ages = []
    # First frames as fast as they come, for the rate; then frames apart, for changes of the light.
    after_ns = start_ns = clock.now_ns()
    rate = 0.0
    for number in range(QUICK + SPACED):
        frame = source.capture(after_ns)
        ages.append(seconds_between(frame.exposed_ns, clock.now_ns()))
        frames.append(frame.image_bgr)
        times_ns.append(frame.exposed_ns)
        if number == QUICK - 1:
            rate = QUICK / max(seconds_between(start_ns, clock.now_ns()), 1e-9)
        after_ns = frame.exposed_ns + (1 if number < QUICK else round(SPACING_S * 1e9))
    # A black or frozen camera explains all other findings, so it is the only one.
    seen = [ImageQuality.of(frame, context.config.view) for frame in frames]
    levels = [each.mean_level for each in seen]
    evidence: dict[str, Any] = {"frame_age_ms": 1e3 * max(ages), "frames_per_s": rate, "mean_levels": levels}
    if max(levels) < context.config.view.min_mean:
        fix: SomeSteps = ("Take the lens cap off and switch the light on, then", Do.DOCTOR())
        yield bad("camera", FindingCode.BLACK, fix, mean_level=max(levels), **evidence)
        return
    if all(np.array_equal(frames[0], frame) for frame in frames[1:]):
        yield bad("camera", FindingCode.CAMERA_FROZEN, again, frames=len(frames), **evidence)
        return
    if max(ages) > MAX_AGE_S:
        yield warning("camera", FindingCode.LATE_FRAMES, "Try another USB port, or reduce camera.width", **evidence)
    elif rate < 0.6 * source.identity.fps:
        fix = "Try another USB port, or reduce camera.exposure_us or camera.fps"
        yield warning("camera", FindingCode.FEW_FRAMES, fix, fps=source.identity.fps, **evidence)
    else:
        yield fine("camera", FindingCode.FRAMES, **evidence)
    yield from _flicker(source, frames, np.array(times_ns), evidence)
    # Would an enrollment accept this view?
    quality = asdict(seen[-1])
    if reasons := seen[-1].reasons(context.config.view):
        fix = (
            "Check light, exposure and focus (an empty table may look blurred). The limits are in [view].",
            Do.SHOW_CONFIGURATION(),
        )
        texts = [rejection_text(reason, seen[-1]) for reason in reasons]
        yield warning("camera", FindingCode.VIEW_REJECTED, fix, reasons=texts, codes=reasons, **quality)
    else:
        yield fine("camera", FindingCode.VIEW_ACCEPTED, **quality)


def green(image_bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return every second column of the green channel, uint8 (height, width / 2): enough for the levels of rows."""
    return image_bgr[:, ::2, 1]


def _flicker(
    source: OpenCvCamera,
    frames: list[NDArray[np.uint8]],
    times_ns: NDArray[np.int64],
    evidence: dict[str, Any],
) -> Iterator[Finding]:
    levels = evidence["mean_levels"]
    spread = (max(levels) - min(levels)) / max(levels)
    lamp = mains_flicker(np.array([green(frame).mean(axis=1) for frame in frames]), times_ns)
    if lamp is None and spread > MAX_FLICKER:
        fix: SomeSteps = (
            "Use a lamp that does not flicker, and keep daylight and shadows away, then",
            Do.DOCTOR(),
        )
        yield warning("camera", FindingCode.FLICKER, fix, spread=spread, seconds=SPACED * SPACING_S, **evidence)
        return
    exposure_us = source.read_locks().exposure_us
    if lamp is None:
        standing = [hz for hz in standing_mains_hz(times_ns) if not _whole_periods(hz, exposure_us)]
        if len(standing) == 1 and exposure_us is not None:
            lamp = _standing_flicker(source, exposure_us, standing[0])
        elif standing:
            reason = "several mains frequencies are possible" if exposure_us else "its exposure time is not known"
            yield fine("camera", FindingCode.STANDING_FLICKER_NOT_CHECKED, mains_hz=standing, reason=reason)
    if lamp is not None:
        fix = Do.SET_KEY(key="camera.exposure_us", value=f"{lamp.exposure_us(exposure_us or 1e4):g}")
        yield warning("camera", FindingCode.MAINS_FLICKER, fix, mains_hz=lamp.mains_hz, depth=lamp.depth)


def _whole_periods(mains_hz: float, exposure_us: float | None) -> bool:
    """Return whether the exposure has no bands."""
    return exposure_us is not None and abs(whole_periods_us(mains_hz, exposure_us) - exposure_us) <= EXPOSURE_STEP_US


def _standing_flicker(source: OpenCvCamera, exposure_us: float, mains_hz: float) -> MainsFlicker | None:
    """Compare images of the exposure in question with images of an exposure without bands."""
    images: list[NDArray[np.uint8]] = []
    times_ns: list[int] = []
    try:
        for time_us in (exposure_us, whole_periods_us(mains_hz, exposure_us)):
            after_ns = source.change_exposure(time_us)
            for _ in range(PER_EXPOSURE):
                frame = source.capture(after_ns)
                after_ns = frame.exposed_ns + 1
                images.append(green(frame.image_bgr))
                times_ns.append(frame.exposed_ns)
    finally:
        source.change_exposure(exposure_us)
    levels = np.stack(images)
    usable = ((levels > DARK) & (levels < BRIGHT)).all(axis=0)  # the same pixels in all images
    rows = (levels * usable).sum(axis=2) / np.maximum(usable.sum(axis=1), 1)
    times = np.array(times_ns)
    with_bands, without = (
        steady_levels(rows[part], times[part], mains_hz) for part in (slice(PER_EXPOSURE), slice(PER_EXPOSURE, None))
    )
    return standing_flicker(with_bands, without, mains_hz)
