"""The base of the simulated servos: supply, supervision of the motor, and methods for tests and faults."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Protocol

from sim.clock import Timer
from sim.servo.models import ServoModel
from sim.servo.motor import Motor
from sim.servo.shaft import Shaft

BOOT_S = 0.2  # silence after power-up or Reboot; the e-manual states no value
SUPERVISION_S = 0.1  # period of the checks of load and temperature while the servo works
RETURN_DELAY_UNIT_NS = 2_000

VOLTAGE_ERROR, OVERHEATING_ERROR, ENCODER_ERROR, ELECTRICAL_ERROR, OVERLOAD_ERROR = 0x01, 0x04, 0x08, 0x10, 0x20
"""Bits of Hardware Error Status and Shutdown; Protocol 1.0 has the same for voltage, heat and overload."""


class Registers(Protocol):
    """A control table; values by register name."""

    def __getitem__(self, name: str) -> int: ...
    def __setitem__(self, name: str, value: int) -> None: ...


class SimulatedServoBase(ABC):
    """A servo with its control table in ``memory`` and its motor on a shaft.

    ``distortions`` are called with the memory after its live registers are updated and before they are read, to falsify
    the readings.
    """

    memory: Registers

    def __init__(self, shaft: Shaft, model: ServoModel) -> None:
        self.model = model
        self.motor = Motor(shaft, model)
        self.distortions: list[Callable[[Any], None]] = []
        self._clock = shaft.clock
        self._registered: tuple[int, bytes] | None = None
        self._powered = True
        self._timers: dict[Callable[[], None], Timer] = {}

    @property
    def bus_id(self) -> int:
        return self.memory["ID"]

    @property
    def return_delay_ns(self) -> int:
        return self.memory["Return Delay Time"] * RETURN_DELAY_UNIT_NS

    @property
    def powered(self) -> bool:
        """Whether the servo has power and has booted."""
        return self._powered

    # -- for tests and faults -------------------------------------------------------------------------------------

    def rotate_by_hand(self, angle_deg: float) -> float:
        """Rotate the shaft by hand by ``angle_deg``; see `Motor.push`."""
        return self.motor.push(angle_deg)

    def jam(self) -> None:
        """Block the shaft."""
        self.motor.jam()
        self._supervise()

    def free(self) -> None:
        """Unblock the shaft."""
        self.motor.free()
        self._supervise()

    def set_voltage(self, supply_v: float) -> None:
        """Set the supply voltage; the servo checks it at once."""
        self.motor.supply_v = supply_v
        self._check_shutdown()

    def set_temperature(self, temperature_c: float) -> None:
        """Set the temperature of the case, from which the thermal model continues."""
        self.motor.set_temperature(temperature_c)
        self._check_shutdown()

    @abstractmethod
    def slip_encoder(self, angle_deg: float) -> None:
        """Let the encoder slip on the shaft by ``angle_deg``; the shaft follows what the encoder now reads."""

    def power_off(self) -> None:
        """Cut the supply."""
        self._powered = False
        self.memory["Torque Enable"] = 0
        self.motor.release()
        for timer in self._timers.values():
            timer.cancel()

    def power_on(self) -> None:
        """Restore the supply; the servo answers after `BOOT_S`."""
        if not self._powered:
            self.power_cycle()

    def power_cycle(self) -> None:
        """Cut the supply and restore it, like Reboot."""
        self.power_off()
        self._schedule(self._start, self._clock.now_ns() + round(BOOT_S * 1e9))

    @abstractmethod
    def _start(self) -> None:
        """Boot: set the RAM to its initial values."""

    @abstractmethod
    def _check_shutdown(self) -> None:
        """Shut down if load, temperature or supply require it."""

    def _schedule(self, action: Callable[[], None], time_ns: int | None) -> None:
        """Call ``action`` at ``time_ns`` instead of at the time scheduled before; None: do not call it."""
        if timer := self._timers.pop(action, None):
            timer.cancel()
        if time_ns is not None:
            self._timers[action] = self._clock.call_at(time_ns, action)

    def _supervise(self) -> None:
        """Check load, temperature and supply now, and repeatedly while the load varies."""
        self.motor.settle()
        self._check_shutdown()
        varies = self._powered and self.motor.busy
        self._schedule(self._supervise, self._clock.now_ns() + round(SUPERVISION_S * 1e9) if varies else None)

    def _supply_and_heat(self) -> int:
        """Return the error bits of the present supply and temperature."""
        motor, memory = self.motor, self.memory
        bits = 0
        if not memory["Min Voltage Limit"] <= motor.supply_v * 10 <= memory["Max Voltage Limit"]:
            bits |= VOLTAGE_ERROR
        if motor.temperature_c(motor.state().load) > memory["Temperature Limit"]:
            bits |= OVERHEATING_ERROR
        return bits
