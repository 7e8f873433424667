"""Simulated faults: they change the simulated world, buses and devices, never a driver.

`fault_kinds` lists them, `Fault` is one with its parameters and its time, `Faults` injects them.
"""

from sim.faults.injector import Faults
from sim.faults.kind import FaultKind
from sim.faults.schedule import Fault, fault_kinds

__all__ = ["Fault", "FaultKind", "Faults", "fault_kinds"]
