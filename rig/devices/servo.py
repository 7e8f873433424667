"""The interface of a servo.

Angles are the encoder's, unwrapped, on the table's side of a gear, without the table's zero and direction.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from rig.config import ServoConfig
from rig.core.clock import Clock


@dataclass(frozen=True, slots=True)
class ServoIdentity:
    """The servo that answers on the bus."""

    model: str
    model_number: int
    bus_id: int
    firmware: int


@dataclass(frozen=True, slots=True)
class MotionProfile:
    """Trapezoid profile: cruise speed and acceleration."""

    velocity_dps: float
    acceleration_dps2: float


@dataclass(frozen=True, slots=True)
class ServoState:
    """One reading of the servo's status registers, from one transaction.

    ``time_ns`` is the middle of the transaction on the bench's clock, ``sampled_ns`` the beginning of the answer, when
    the servo read its encoder, to a fraction of a millisecond; None if the driver does not know it. ``hardware_errors``
    are the names of the bits in Hardware Error Status (a status alert). ``moving`` is False when the motion profile has
    ended and the shaft is slow. ``in_position`` is whether the servo reports that it is at its goal; friction may hold
    it outside of its window. ``trajectory_deg`` and ``trajectory_dps`` are the present position and speed of the
    servo's motion profile, which the shaft follows with a lag; None if the model does not report them.
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
    trajectory_dps: float | None = None
    sampled_ns: int | None = None


@dataclass(frozen=True, slots=True)
class ServoCondition:
    """The servo's condition when it is opened, before anything is written to it.

    ``power_lost`` is whether its volatile registers have the values of power-up. If so, the servo lost its supply, and
    with it the count of its revolutions, since the rig last set a profile.
    """

    torque: bool
    watchdog_armed: bool
    watchdog_tripped: bool
    power_lost: bool
    hardware_errors: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class ServoLimits:
    """Limits at which the servo shuts down."""

    temperature_c: float
    voltage_v: tuple[float, float]


class Servo(Protocol):
    """A position servo that rotates the table."""

    def prepare(self, *, write: bool) -> tuple[str, ...]:
        """Compare the servo's permanent settings with the required ones; return the changes.

        Raises `DeviceMismatch`: settings differ, and ``write`` is False.
        """

    @property
    def identity(self) -> ServoIdentity: ...

    @property
    def resolution_deg(self) -> float:
        """Angle of one encoder count."""

    @property
    def profile_units(self) -> MotionProfile:
        """Smallest steps of a profile's speed and acceleration."""

    @property
    def revolution_deg(self) -> float:
        """Angle after which the encoder repeats; without supply, the servo loses the count of these."""

    @property
    def limits(self) -> ServoLimits: ...

    @property
    def reach_deg(self) -> tuple[float, float]:
        """Lowest and highest position in the present mode."""

    @property
    def bus_statistics(self) -> Mapping[str, int]:
        """Statistics since the bus was opened: transactions, retries and their causes."""

    def read_state(self) -> ServoState: ...
    def read_condition(self) -> ServoCondition: ...

    def verify(self) -> None:
        """Raise `DeviceMismatch` unless the servo that was opened answers, with the settings that the rig needs.

        Call it after a cable was unplugged, after a reboot, or when the servo may have been replaced.
        """

    def reboot(self) -> None:
        """Restart the servo, which clears its hardware errors, torque and count of revolutions; then `verify` it."""

    def set_profile(self, profile: MotionProfile) -> MotionProfile:
        """Set the profile; return it rounded to the servo's units."""

    def torque_on(self) -> None:
        """Set the goal to the present position, then switch the torque on."""

    def torque_off(self) -> None:
        """Switch the torque off and read it back; raise `TorqueStaysOn` if it is still on."""
        ...

    def move_to(self, position_deg: float) -> None:
        """Set the goal position and return at once."""

    def arm_watchdog(self, timeout_s: float) -> None:
        """Make the servo stop by itself if it receives nothing for ``timeout_s``."""

    def disarm_watchdog(self) -> None: ...
    def close(self) -> None: ...


class ServoDriver(Protocol):
    """Opens a servo of another make. A package names it in the entry-point group ``rig.servos``.

    ``connection`` is the open port ``servo.port`` with pyserial's interface, ``mode`` is `table.mode`, and ``reopen``
    opens the port again after its adapter was unplugged. Opening moves nothing and leaves the torque as it is.
    """

    def __call__(
        self, connection: Any, config: ServoConfig, clock: Clock, *, mode: str, reopen: Callable[[], Any] | None
    ) -> Servo: ...
