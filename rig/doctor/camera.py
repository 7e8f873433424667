"""Check the camera: its mode, its locks, and the age and quality of its frames."""

from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.bench.hardware import camera_settings, store_focus
from rig.core.clock import seconds_between
from rig.core.next_steps import Do, SomeSteps
from rig.devices.camera import CameraLocks
from rig.devices.opencv_camera import NO_CONTROL, OpenCvCamera
from rig.devices.v4l2 import choose_mode
from rig.doctor.context import DoctorContext
from rig.doctor.finding import Finding, FindingCode, bad, fine, warning
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
    size = f"{wanted.width}x{wanted.height} at {wanted.fps:.3g} frames/s"
    if nearest is None:
        usable = choose_mode(source.modes, wanted.width, wanted.height, wanted.fps)
        if usable is not None:
            fix: SomeSteps = Do.SET_KEY(key="camera.fourcc", value="none")
            yield warning(
                "camera", FindingCode.MODE_NOT_OFFERED, fix, wanted=f"{size} ({wanted.fourcc})", nearest=usable
            )
        return
    if (nearest.width, nearest.height) != (wanted.width, wanted.height) or 0 < nearest.fps < 0.9 * wanted.fps:
        yield warning("camera", FindingCode.MODE_NOT_OFFERED, Do.SETUP(), wanted=size, nearest=nearest)


def _locks(context: DoctorContext, source: OpenCvCamera) -> Iterator[Finding]:
    locks = source.read_locks()
    fix = f"v4l2-ctl --list-ctrls-menus -d {context.config.camera.source}"
    for one in source.rejected_settings:
        found = {"setting": one.setting, "requested": one.asked, "reported": one.reported}
        steps: SomeSteps = fix
        if one.reported == NO_CONTROL:
            key = "exposure_us" if one.setting == "exposure_100us" else one.setting
            steps = (
                "Views of one object differ if the light changes: keep it constant, or use a camera with this control.",
                Do.SET_KEY(key=f"camera.{key}", value="none"),
            )
        yield warning("camera", FindingCode.SETTING_REJECTED, steps, **found)
    wanted = context.config.camera
    not_locked = [
        name
        for name, loose in (
            ("exposure", locks.auto_exposure),
            ("white balance", locks.auto_white_balance),
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
_STANDING_CYCLES = _CYCLES[_CYCLES >= 0.75]
"""Smallest number of bands; fewer look like a change of the scene from its top to its bottom."""


@dataclass(frozen=True, slots=True)
class MainsFlicker:
    """Flicker at twice the mains frequency; ``depth`` is its amplitude as a share of the mean level."""

    mains_hz: float
    depth: float

    def exposure_us(self, wanted_us: float) -> float:
        """Return the exposure time without bands that is nearest to ``wanted_us``: whole periods of the lamp."""
        return whole_periods_us(self.mains_hz, wanted_us)


def whole_periods_us(mains_hz: float, wanted_us: float) -> float:
    """Return the exposure time without bands that is nearest to ``wanted_us``."""
    period_us = 1e6 / (2 * mains_hz)
    return float(round(max(round(wanted_us / period_us), 1) * period_us))


def mains_flicker(row_levels: NDArray[np.float64], times_ns: NDArray[np.int64]) -> MainsFlicker | None:
    """Return the flicker of a still scene; None if there is none.

    The row at the share y of the height is exposed later by y times the readout. So a lamp with the frequency f adds
    cos(2π (f t + c y)) to the image at time t, with c bands. Both are fitted to the changes of each row. Bands that
    stand still, because f is a multiple of the frame rate, are not recognised: see `standing_flicker`.

    ``row_levels``, float64 (n, H), is the mean level of each row of n images at ``times_ns``, int64 (n,).
    """
    count, height = row_levels.shape
    if count < 4 or height < _BLOCKS:
        return None
    usable = _blocks(row_levels)
    mean = usable.mean(axis=0)
    changes = usable / np.maximum(mean, 1.0) - 1.0
    power = float((changes**2).mean())
    if power == 0.0:
        return None
    bands = np.exp(-2j * np.pi * np.outer(_MIDDLES, _CYCLES))
    best: tuple[float, float] = (0.0, 0.0)
    for mains_hz in MAINS_HZ:
        phases = _phases(mains_hz, times_ns)
        if (weight := float((np.abs(phases) ** 2).mean())) < _STANDS:
            continue
        fitted = np.abs(phases @ changes @ bands).max() / (count * _BLOCKS * weight)
        best = max(best, (2 * float(fitted), mains_hz))
    depth, mains_hz = best
    explained = depth**2 / 2 / power
    return MainsFlicker(mains_hz, depth) if depth >= MIN_DEPTH and explained >= _MIN_EXPLAINED else None


def standing_mains_hz(times_ns: NDArray[np.int64]) -> tuple[float, ...]:
    """Return the mains frequencies whose bands stand still in images of these times, int64 (n,)."""
    return tuple(hz for hz in MAINS_HZ if (np.abs(_phases(hz, times_ns)) ** 2).mean() < _STANDS)


def steady_levels(row_levels: NDArray[np.float64], times_ns: NDArray[np.int64], mains_hz: float) -> NDArray[np.float64]:
    """Return the level of each row without the bands of the other mains frequencies, which move from image to image.

    ``row_levels``, float64 (n, H), is the mean level of each row of n images, 4 or more, at ``times_ns``, int64 (n,).
    The bands of ``mains_hz`` stand still. Returns float64 (H,).
    """
    columns = [np.ones(len(times_ns))]
    for other_hz in MAINS_HZ:
        if other_hz != mains_hz:
            phases = _phases(other_hz, times_ns)
            columns += [phases.real, phases.imag]
    return np.asarray(np.linalg.lstsq(np.stack(columns, axis=1), row_levels, rcond=None)[0][0])


def standing_flicker(
    with_bands: NDArray[np.float64], without: NDArray[np.float64], mains_hz: float
) -> MainsFlicker | None:
    """Return the flicker whose bands stand still in the images of one exposure time; None if there is none.

    One exposure time does not separate bands from the scene. An exposure of whole periods of the lamp has no bands:
    the quotient of both is the bands, and a smooth function of the level if the camera's response is not linear.
    Decision: docs/decisions/0008.

    ``with_bands``, float64 (H,), is the mean level of each row at the exposure time in question, ``without`` the same
    at an exposure time of whole periods of the lamp.
    """
    if len(without) < _BLOCKS:
        return None
    one, other = _blocks(with_bands), _blocks(without)
    lit = (one > 1.0) & (other > 1.0)
    if lit.sum() < _BLOCKS / 2:
        return None
    quotient, y = np.log(one[lit] / other[lit]), _MIDDLES[lit]
    response = np.stack([np.ones(len(y)), np.log(other[lit])], axis=1)
    unexplained = _residual(response, quotient)[1]
    best: tuple[float, float] = (0.0, 0.0)
    for cycles in _STANDING_CYCLES:
        waves = np.stack([np.cos(2 * np.pi * cycles * y), np.sin(2 * np.pi * cycles * y)], axis=1)
        fitted, rest = _residual(np.hstack([response, waves]), quotient)
        best = max(best, (1.0 - rest / max(unexplained, 1e-12), float(np.hypot(*fitted[-2:]))))
    explained, depth = best
    return MainsFlicker(mains_hz, depth) if depth >= MIN_DEPTH and explained >= _MIN_EXPLAINED else None


_MIDDLES = (np.arange(_BLOCKS) + 0.5) / _BLOCKS


def _blocks(row_levels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean of blocks of rows, float64 (..., `_BLOCKS`)."""
    height = row_levels.shape[-1]
    usable = row_levels[..., : height - height % _BLOCKS]
    return np.asarray(usable.reshape(*usable.shape[:-1], _BLOCKS, -1).mean(axis=-1))


def _phases(mains_hz: float, times_ns: NDArray[np.int64]) -> NDArray[np.complex128]:
    """Return the lamp's phase in each image as a complex number, without the mean, which is part of the scene."""
    phases = np.exp(-2j * np.pi * 2 * mains_hz * (times_ns - times_ns[0]) * 1e-9)
    return np.asarray(phases - phases.mean())


def _residual(design: NDArray[np.float64], values: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the coefficients of a fit by least squares, and the mean square of its residuals."""
    fitted = np.asarray(np.linalg.lstsq(design, values, rcond=None)[0], dtype=np.float64)
    return fitted, float(((values - design @ fitted) ** 2).mean())


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
