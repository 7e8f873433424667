"""Check the camera: its mode, its locks, and the age and quality of its frames."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.bench.hardware import camera_settings, store_focus
from rig.core.clock import seconds_between
from rig.core.next_steps import Do, NextStep, SomeSteps
from rig.devices.opencv_camera import NO_CONTROL, OpenCvCamera
from rig.devices.v4l2 import choose_mode
from rig.doctor.examination import DoctorContext
from rig.doctor.finding import Finding, bad, fine, warning
from rig.safety.saved_state import FileStore
from rig.views.capture import ImageQuality, rejection_text

LOCKABLE = (
    *("exposure_us", "white_balance_k", "gain", "focus", "sharpness"),
    *("backlight_compensation", "power_line_frequency", "dynamic_frame_rate"),
)
"""Settings that a camera reports, by their keys in ``[camera]``."""
QUICK, SPACED, SPACING_S = 5, 6, 0.17
"""Consecutive frames, which show the frame rate, and frames spread over a second, which show flicker."""
MAX_AGE_S = 0.25
"""Largest time from the start of an exposure until the program has the frame; the table waits for it at each view."""
EXPOSURE_STEP_US = 100.0
"""Cameras round exposure times to this step."""
MAX_FLICKER = 0.05  # largest spread of the mean level of frames of one scene


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
        "dynamic_frame_rate": locks.dynamic_frame_rate,
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
    yield from _flicker(source.read_locks().exposure_us, frames, np.array(times_ns), evidence)
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


# -- lamps that flicker with the mains: the bands that they leave in the images of a rolling shutter -------------------

MAINS_HZ = (50.0, 60.0)  # a lamp flickers at twice this rate
MIN_DEPTH = 0.01
"""Smallest amplitude, as a share of the mean level, that counts."""
_MIN_EXPLAINED = 0.6  # less: something else changes the light, such as a person who passes
_STANDS = 0.1
"""Variance of the lamp's phase from image to image below which bands stand still; 1 if all phases occur."""
_CYCLES = np.arange(0.0, 8.01, 0.125)
"""Bands in an image: at most 8, for a readout of 67 ms at 120 Hz."""
_BLOCKS = 48  # six for each band at most; more blocks are noisier


class MainsFlicker(NamedTuple):
    """Flicker at twice the mains frequency; ``depth`` is its amplitude as a share of the mean level."""

    mains_hz: float
    depth: float


def whole_periods_us(mains_hz: float, wanted_us: float) -> float:
    """Return the exposure time without bands that is nearest to ``wanted_us``: whole periods of the lamp."""
    period_us = 1e6 / (2 * mains_hz)
    return float(round(max(round(wanted_us / period_us), 1) * period_us))


def mains_flicker(row_levels: NDArray[np.float64], times_ns: NDArray[np.int64]) -> MainsFlicker | None:
    """Return the flicker of a still scene; None if there is none.

    The row at the share y of the height is exposed later by y times the readout. So a lamp with the frequency f adds
    cos(2π (f t + c y)) to the image at time t, with c bands. Both are fitted to the changes of each row. Bands that
    stand still, because f is a multiple of the frame rate, cannot be told from the scene: see `standing_mains_hz`.

    ``row_levels``, float64 (n, H), is the mean level of each row of n images at ``times_ns``, int64 (n,).
    """
    count, height = row_levels.shape
    if count < 4 or height < _BLOCKS:
        return None
    blocks = row_levels[:, : height - height % _BLOCKS].reshape(count, _BLOCKS, -1).mean(axis=-1)
    changes = blocks / np.maximum(blocks.mean(axis=0), 1.0) - 1.0
    power = float((changes**2).mean())
    if power == 0.0:
        return None
    bands = np.exp(-2j * np.pi * np.outer((np.arange(_BLOCKS) + 0.5) / _BLOCKS, _CYCLES))
    best = MainsFlicker(0.0, 0.0)
    for mains_hz in MAINS_HZ:
        phases = _phases(mains_hz, times_ns)
        if (weight := float((np.abs(phases) ** 2).mean())) >= _STANDS:
            fitted = np.abs(phases @ changes @ bands).max() / (count * _BLOCKS * weight)
            best = max(best, MainsFlicker(mains_hz, 2 * float(fitted)), key=lambda one: one.depth)
    explained = best.depth**2 / 2 / power
    return best if best.depth >= MIN_DEPTH and explained >= _MIN_EXPLAINED else None


def standing_mains_hz(times_ns: NDArray[np.int64]) -> tuple[float, ...]:
    """Return the mains frequencies whose bands stand still in images of these times, int64 (n,)."""
    return tuple(hz for hz in MAINS_HZ if (np.abs(_phases(hz, times_ns)) ** 2).mean() < _STANDS)


def _phases(mains_hz: float, times_ns: NDArray[np.int64]) -> NDArray[np.complex128]:
    """Return the lamp's phase in each image as a complex number, without the mean, which is part of the scene."""
    phases = np.exp(-2j * np.pi * 2 * mains_hz * (times_ns - times_ns[0]) * 1e-9)
    return np.asarray(phases - phases.mean())


def _flicker(
    exposure_us: float | None, frames: list[NDArray[np.uint8]], times_ns: NDArray[np.int64], evidence: dict[str, Any]
) -> Iterator[Finding]:
    levels = evidence["mean_levels"]
    spread = (max(levels) - min(levels)) / max(levels)
    # Every second column of the green channel is enough for the levels of rows.
    lamp = mains_flicker(np.array([frame[:, ::2, 1].mean(axis=1) for frame in frames]), times_ns)
    without = "an exposure of whole periods of the lamp has none"
    if lamp is not None:
        text = "the lamps flicker with the mains ({mains_hz:.0f} Hz): bands of {depth:.0%} in the images; " + without
        yield warning("mains_flicker", text, _exposure_without_bands(lamp.mains_hz, exposure_us), **lamp._asdict())
    elif spread > MAX_FLICKER:
        text = "the light changes by {spread:.0%} within {seconds:.0f} s"
        fix = "Use a lamp that does not flicker, and keep daylight and shadows away"
        yield warning("flicker", text, fix, spread=spread, seconds=SPACED * SPACING_S, **evidence)
    else:
        for hz in standing_mains_hz(times_ns):
            if exposure_us is None or abs(whole_periods_us(hz, exposure_us) - exposure_us) > EXPOSURE_STEP_US:
                seen = "bands of lamps at {mains_hz:.0f} Hz mains would stand still in the images, and are not checked"
                step = _exposure_without_bands(hz, exposure_us)
                yield fine("standing_flicker_not_checked", f"{seen}; {without}", step, mains_hz=hz)


def _exposure_without_bands(mains_hz: float, exposure_us: float | None) -> NextStep:
    return Do.SET_KEY(key="camera.exposure_us", value=f"{whole_periods_us(mains_hz, exposure_us or 1e4):g}")
