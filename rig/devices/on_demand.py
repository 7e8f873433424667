"""A device that is opened when it is first used."""

from collections.abc import Callable
from typing import Any, Generic, TypeVar

Device = TypeVar("Device")


class OnDemand(Generic[Device]):
    """A device that is opened at its first use; its methods also raise the errors of opening it.

    Parameters
    ----------
    open_device
        Opens the device.
    """

    def __init__(self, open_device: Callable[[], Device]) -> None:
        self._open_device = open_device
        self._device: Device | None = None

    @property
    def is_open(self) -> bool:
        return self._device is not None

    def open(self) -> Device:
        """Return the device, open."""
        if self._device is None:
            self._device = self._open_device()
        return self._device

    def close(self) -> None:
        """Close the device if it was used."""
        if self._device is not None:
            self._device.close()  # type: ignore[attr-defined]

    def __getattr__(self, name: str) -> Any:
        return getattr(self.open(), name)
