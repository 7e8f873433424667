"""The simulated world: the true state behind the simulated servo, IMU and camera, and its recent past.

Drivers reach the emulated devices through their buses. Tests set and read this world.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, Protocol
from zlib import crc32

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.clock import VirtualClock
from sim.motion import Floats, PiecewiseMotion, Platter, rest, ripple_deg
from sim.noise import NoiseModel

HISTORY_S = 12.0  # time for which the past is stored: longer than the IMU's FIFO and the camera's buffers


class SimObject(Protocol):
    """An object that can stand on the platter."""

    @property
    def name(self) -> str: ...

    def draw(self, image: NDArray[np.uint8], azimuth_deg: float, offset_mm: tuple[float, float]) -> None:
        """Draw the object into ``image``, uint8 (480, 640, 3), which shows the empty platter.

        ``azimuth_deg`` is the object's counter-clockwise rotation seen from above; ``offset_mm`` is the position of its
        axis in the room, as in `sim.objects.projection`.
        """


@dataclass(frozen=True, slots=True)
class Scene:
    """The scene before the camera, apart from the table's angle.

    ``yaw_deg`` is the object's counter-clockwise rotation relative to the platter, ``offset_mm`` the position of its
    axis in the platter's frame, ``light`` the light relative to the nominal light, as B, G, R, ``mark`` the card of the
    home mark.
    """

    object: SimObject | None = None
    yaw_deg: float = 0.0
    offset_mm: tuple[float, float] = (0.0, 0.0)
    light: tuple[float, float, float] = (1.0, 1.0, 1.0)
    mark: SimObject | None = None


class Activity(Enum):
    """An activity that a simulated fault can wait for."""

    MOTION_STARTED = "the shaft starts to rotate"
    FRAME_FETCHED = "a frame is fetched from the camera"


class World:
    """True state of the simulated bench on its virtual clock.

    Angles are the table's, in degrees, unwrapped, counter-clockwise seen from above. The table starts at ``start_deg``.
    ``noise`` and ``seed`` determine the whole run: each emulator draws from its own stream (`rng`), so one more reading
    of one device does not change another device. ``listeners`` are called with each `Activity`.
    """

    def __init__(
        self,
        *,
        noise: NoiseModel | None = None,
        seed: int = 0,
        clock: VirtualClock | None = None,
        start_deg: float = 0.0,
    ) -> None:
        self.clock = clock or VirtualClock()
        self.noise = noise or NoiseModel()
        self.seed = seed
        self.listeners: list[Callable[[Activity], None]] = []
        self._scenes: list[tuple[int, Scene]] = [(0, Scene())]
        first = self._platter()
        first.follow(rest(0.0, start_deg), None)
        self._motions: list[tuple[int, Platter]] = [(0, first)]
        self._slips: list[tuple[float, float, float]] = []

    def rng(self, name: str) -> np.random.Generator:
        """Return a fresh generator for the stream ``name`` of this world's seed."""
        return np.random.default_rng([self.seed, crc32(name.encode())])

    # -- the table ------------------------------------------------------------------------------------------------

    def drive(self, shaft: PiecewiseMotion) -> None:
        """Make the servo's shaft follow ``shaft`` from now on."""
        now_ns = self.clock.now_ns()
        standing = self.shaft()[1] == 0
        platter = self._platter()
        platter.follow(shaft, self._motions[-1][1])
        self._motions.append((now_ns, platter))
        self._forget(self._motions, now_ns)
        if standing and shaft.end_s > shaft.start_s[0]:
            self.notify(Activity.MOTION_STARTED)

    def notify(self, activity: Activity) -> None:
        """Call the listeners."""
        for listener in tuple(self.listeners):
            listener(activity)

    def slip(self, angle_deg: float, seconds: float = 0.001) -> None:
        """Rotate the platter by ``angle_deg`` against the shaft at a constant rate, as when it is loose or pushed."""
        self._slips.append((self.clock.now_ns() * 1e-9, seconds, angle_deg))

    def shaft(self, time_ns: int | None = None) -> tuple[float, float]:
        """Return angle (°) and speed (°/s) of the servo's shaft, without ripple."""
        t = self.clock.now_ns() if time_ns is None else time_ns
        x, v, _ = self._motions[self._index(t)][1].shaft.state_at(t * 1e-9)
        return x, v

    def rippled_deg(self) -> float:
        """Return the angle of the servo's shaft with the ripple of its speed, as the encoder sees it."""
        angle_deg, speed_dps = self.shaft()
        return angle_deg + float(ripple_deg(self.noise.speed_ripple, angle_deg, speed_dps))

    def table_deg(self, time_ns: int | None = None) -> float:
        """Return the true angle of the platter, now or at a time not longer ago than `HISTORY_S`."""
        return float(self.table_angles([self.clock.now_ns() if time_ns is None else time_ns])[0])

    def table_angles(self, times_ns: ArrayLike) -> Floats:
        """Return the platter's true angle (°) at each of the given times, int64 (n,)."""
        t: NDArray[np.int64] = np.atleast_1d(np.asarray(times_ns, dtype=np.int64))
        first, last = self._index(int(t.min())), self._index(int(t.max()))
        if first == last:
            angle = self._motions[first][1].at(t * 1e-9)
        else:
            starts = np.array([start for start, _ in self._motions])
            which = np.maximum(np.searchsorted(starts, t, side="right") - 1, 0)
            angle = np.empty(t.shape)
            for i in range(first, last + 1):
                here = which == i
                angle[here] = self._motions[i][1].at(t[here] * 1e-9)
        for start_s, seconds, slip_deg in self._slips:
            angle += slip_deg * np.clip((t * 1e-9 - start_s) / seconds, 0.0, 1.0)
        return angle

    # -- the object on it -----------------------------------------------------------------------------------------

    @property
    def scene(self) -> Scene:
        return self._scenes[-1][1]

    def scene_at(self, time_ns: int) -> Scene:
        return next((scene for start, scene in reversed(self._scenes) if start <= time_ns), self._scenes[0][1])

    def change(self, **values: Any) -> None:
        """Change fields of the `Scene` from now on."""
        now_ns = self.clock.now_ns()
        self._scenes.append((now_ns, replace(self.scene, **values)))
        self._forget(self._scenes, now_ns)

    def put(self, object: SimObject | None, yaw_deg: float = 0.0, offset_mm: tuple[float, float] = (0.0, 0.0)) -> None:
        """Put ``object`` (or nothing) on the platter, rotated by ``yaw_deg`` against the platter's mark."""
        self.change(object=object, yaw_deg=yaw_deg, offset_mm=offset_mm)

    def _platter(self) -> Platter:
        noise = self.noise
        return Platter(noise.backlash_deg, noise.structure_hz, noise.structure_damping, noise.speed_ripple)

    def _index(self, time_ns: int) -> int:
        for i in range(len(self._motions) - 1, 0, -1):
            if self._motions[i][0] <= time_ns:
                return i
        return 0

    @staticmethod
    def _forget(history: list[Any], now_ns: int) -> None:
        """Remove the entries that ended before the history's horizon."""
        horizon = now_ns - round(HISTORY_S * 1e9)
        while len(history) > 1 and history[1][0] <= horizon:
            del history[0]
