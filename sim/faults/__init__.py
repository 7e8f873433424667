"""Simulated faults: they change the simulated world, buses and devices, never a driver.

`fault_kinds` lists them, `Fault` is one with its parameters and its time, `Faults` injects them.
"""

from sim.faults import camera, environment, imu, servo  # noqa: F401 - each module registers its faults
from sim.faults.injector import Faults
from sim.faults.kind import Fault, FaultKind, fault_kinds

__all__ = ["Fault", "FaultKind", "Faults", "fault_kinds"]
