"""What the rig asks of a servo; angles are the encoder's own, unwrapped, before any zero or direction of the table."""

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class ServoIdentity:
    """Who answers on the bus."""

    model: str
    model_number: int
    bus_id: int
    firmware: int


@dataclass(frozen=True, slots=True)
class MotionProfile:
    """Trapezoid profile: cruise speed and ramp."""

    velocity_dps: float
    acceleration_dps2: float


@dataclass(frozen=True, slots=True)
class ServoState:
    """One reading of the servo's status registers, all from one transaction.

    ``time_ns`` is the middle of the transaction on the bench's clock, ``hardware_errors`` the names of the bits set in
    Hardware Error Status (a status alert), empty when the servo is well.
    """

    time_ns: int
    position_deg: float
    velocity_dps: float
    load_percent: float
    voltage_v: float
    temperature_c: float
    moving: bool
    in_position: bool
    hardware_errors: tuple[str, ...]


class Servo(Protocol):
    """A position servo that turns the table."""

    @property
    def identity(self) -> ServoIdentity: ...

    @property
    def resolution_deg(self) -> float:
        """Angle of one encoder count."""
        ...

    def read_state(self) -> ServoState: ...

    def set_profile(self, profile: MotionProfile) -> MotionProfile:
        """Set the profile and return the one that the servo's units allow."""
        ...

    def torque_on(self) -> None:
        """Hold the present position: goal := present, then torque."""
        ...

    def torque_off(self) -> None: ...

    def move_to(self, position_deg: float) -> None:
        """Set the goal position and return at once."""
        ...

    def arm_watchdog(self, timeout_s: float) -> None:
        """Have the servo stop by itself when it hears nothing for ``timeout_s``."""
        ...

    def disarm_watchdog(self) -> None: ...

    def close(self) -> None: ...
