"""What the rig asks of a servo.

Angles are the encoder's own, unwrapped, on the table's side of a gear, before any zero or direction of the table.
"""

from collections.abc import Mapping
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
    Hardware Error Status (a status alert), empty when the servo is well. ``trajectory_deg`` is where the servo's own
    profile wants the shaft to be now; None where the model does not tell.
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
    trajectory_deg: float | None = None


@dataclass(frozen=True, slots=True)
class ServoCondition:
    """What a servo was left in; read before anything is written to it.

    ``power_lost`` says that its volatile registers are as after power-up: since the rig last set a profile it was
    without supply, and with it the count of its turns was lost.
    """

    torque: bool
    watchdog_armed: bool
    watchdog_tripped: bool
    power_lost: bool
    hardware_errors: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class ServoLimits:
    """Where the servo shuts down by itself."""

    temperature_c: float
    voltage_v: tuple[float, float]


class Servo(Protocol):
    """A position servo that turns the table."""

    @property
    def identity(self) -> ServoIdentity: ...

    @property
    def resolution_deg(self) -> float:
        """Angle of one encoder count."""
        ...

    @property
    def turn_deg(self) -> float:
        """Angle after which the encoder reads the same again: what a servo without supply loses count of."""
        ...

    @property
    def limits(self) -> ServoLimits: ...

    @property
    def reach_deg(self) -> tuple[float, float]:
        """Lowest and highest position that it can go to, in the mode it is used in."""
        ...

    @property
    def bus_statistics(self) -> Mapping[str, int]:
        """What the line was like since it was opened: transactions, retries and what they were for."""
        ...

    def read_state(self) -> ServoState: ...

    def read_condition(self) -> ServoCondition: ...

    def verify(self) -> None:
        """Raise `DeviceMismatch` unless the servo that answers is the one that was opened, set up as the rig needs it.

        For what may have happened meanwhile: a pulled cable, a reboot, a servo that was replaced.
        """
        ...

    def reboot(self) -> None:
        """Restart the servo, which clears its hardware errors, its torque and the count of its turns; then `verify`."""
        ...

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
