"""What the rig asks of a camera."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class CameraIdentity:
    """Which camera it is and the mode it runs in."""

    name: str
    width: int
    height: int
    fps: float


@dataclass(frozen=True, slots=True)
class CameraLocks:
    """Settings that must not drift between enrollment and query; None where the camera does not tell."""

    exposure_us: float | None
    gain: float | None
    white_balance_k: float | None
    auto_exposure: bool | None
    auto_white_balance: bool | None
    focus: float | None = None
    autofocus: bool | None = None


@dataclass(frozen=True, slots=True)
class Frame:
    """An image with its evidence: ``exposed_ns`` is the start of its exposure on the bench's clock."""

    image_bgr: NDArray[np.uint8]
    exposed_ns: int


class Camera(Protocol):
    """A source of frames."""

    @property
    def identity(self) -> CameraIdentity: ...

    def capture(self, after_ns: int, meanwhile: Callable[[], object] | None = None) -> Frame:
        """Return the first frame whose exposure began at or after ``after_ns``; older frames are dropped.

        ``meanwhile`` is called several times a second while a slow camera is waited for.
        """
        ...

    def read_locks(self) -> CameraLocks:
        """Return the settings as the camera reports them now."""
        ...

    def close(self) -> None: ...
