"""Check the camera: its mode, its locks, and the age and quality of its frames."""

from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np

from rig.core.clock import seconds_between
from rig.core.errors import DeviceNotFound
from rig.devices.camera import Camera
from rig.devices.opencv_camera import CameraSettings, OpenCvCamera
from rig.doctor.context import DoctorContext
from rig.doctor.finding import Finding, bad, fine, of_error, warning
from rig.views.capture import ImageQuality, rejection_text

QUICK, SPACED, SPACING_S = 5, 6, 0.17
"""Consecutive frames, which show the frame rate, and frames spread over a second, which show flicker."""
MAX_AGE_S = 0.25
"""Time from the start of an exposure until the program has the frame; the table waits that long at each view."""
MAX_FLICKER = 0.05  # largest spread of the mean level of frames of one scene


def camera(context: DoctorContext) -> Iterator[Finding]:
    """Open the camera, lock its settings, and take some frames."""
    if context.holder is not None:
        yield warning("camera", "not opened: the bench is in use", context.rig("stop"))
        return
    config = context.config.camera
    try:
        capture = context.computer.open_capture(config.source)
    except DeviceNotFound as error:
        yield of_error("camera", error)
        return
    with ExitStack() as opened:
        opened.callback(capture.release)
        settings = CameraSettings(**config.model_dump(exclude={"source"}))
        source = OpenCvCamera(capture, clock=context.computer.clock, settings=settings, name=f"camera {config.source}")
        identity = source.identity
        context.identities["camera"] = {name: getattr(identity, name) for name in identity.__dataclass_fields__}
        text = f"{identity.name}: {identity.width}x{identity.height} at {identity.fps:.3g} frames/s"
        yield fine("camera", f"{text}, frames timed by {source.time_base.value} exposure")
        yield from _locks(context, source)
        yield from _frames(context, source)


def _locks(context: DoctorContext, source: OpenCvCamera) -> Iterator[Finding]:
    locks = source.read_locks()
    device = f" -d {context.config.camera.source}"
    for refused in source.rejected_settings:
        yield warning(
            "camera",
            f"{refused.setting}: requested {refused.asked:g}, the camera reports {refused.reported:g}",
            "v4l2-ctl --list-ctrls-menus" + device,
        )
    automatic = [
        name
        for name, value, wanted in (
            ("exposure", locks.auto_exposure, context.config.camera.exposure_us),
            ("white balance", locks.auto_white_balance, context.config.camera.white_balance_k),
        )
        if value or (value is None and wanted is not None)
    ]
    if automatic:
        text = f"{' and '.join(automatic)} not locked: views of one object may differ"
        yield warning("camera", text, "v4l2-ctl --list-ctrls-menus" + device)
    elif not source.rejected_settings:
        exposure = "?" if locks.exposure_us is None else f"{locks.exposure_us / 1e3:.3g} ms"
        balance = "?" if locks.white_balance_k is None else f"{locks.white_balance_k:.0f} K"
        yield fine("camera", f"locked and read back: exposure {exposure}, white balance {balance}")


def _frames(context: DoctorContext, source: Camera) -> Iterator[Finding]:
    clock = context.computer.clock
    again = "Unplug the camera, plug it in again, then: " + context.rig("doctor")
    frames = []
    ages = []
    after_ns = start_ns = clock.now_ns()
    rate = 0.0
    for number in range(QUICK + SPACED):
        frame = source.capture(after_ns)
        ages.append(seconds_between(frame.exposed_ns, clock.now_ns()))
        frames.append(frame.image_bgr)
        if number == QUICK - 1:
            rate = QUICK / max(seconds_between(start_ns, clock.now_ns()), 1e-9)
        after_ns = frame.exposed_ns + (1 if number < QUICK else round(SPACING_S * 1e9))
    seen = [ImageQuality.of(frame, context.config.view) for frame in frames]
    levels = [each.mean_level for each in seen]
    text = f"frames arrive {1e3 * max(ages):.0f} ms after exposure, {rate:.3g} a second"
    evidence: dict[str, Any] = {"frame_age_s": max(ages), "frames_per_s": rate, "mean_levels": levels}
    if max(levels) < context.config.view.min_mean:
        fix = "Take the lens cap off and switch the light on, then: " + context.rig("doctor")
        yield bad("camera", f"black: mean level {max(levels):.1f} of 255", fix, **evidence)
        return
    if all(np.array_equal(frames[0], frame) for frame in frames[1:]):
        yield bad("camera", f"frozen: {len(frames)} frames are identical", again, **evidence)
        return
    if max(ages) > MAX_AGE_S:
        yield warning("camera", f"{text}: too old", "Try another USB port, or reduce camera.width", **evidence)
    elif rate < 0.6 * source.identity.fps:
        fix = "Try another USB port, or reduce camera.exposure_us or camera.fps"
        yield warning("camera", f"{text}, not {source.identity.fps:.3g}", fix, **evidence)
    else:
        yield fine("camera", text, **evidence)
    spread = (max(levels) - min(levels)) / max(levels)
    if spread > MAX_FLICKER:
        fix = "Use a lamp that does not flicker, and keep daylight and shadows away, then: " + context.rig("doctor")
        yield warning("camera", f"the light changes by {spread:.0%} within {SPACED * SPACING_S:.0f} s", fix, **evidence)
    words = f"mean level {levels[-1]:.0f}, sharpness {seen[-1].sharpness:.0f}, {seen[-1].saturated_share:.1%} saturated"
    if reasons := seen[-1].reasons(context.config.view):
        texts = "; ".join(rejection_text(reason, seen[-1]) for reason in reasons)
        fix = "Check light, exposure and focus (an empty table may look blurred): " + context.rig("config show view")
        yield warning("camera", f"a view would be rejected now: {texts}", fix)
    else:
        yield fine("camera", f"a view would be accepted now: {words}")
