"""What can go wrong on a bench, for the simulated one to suffer: in its world, on its wires, in its devices.

Nothing here touches a driver. `kinds` is the vocabulary, `Fault` one entry of it with its parameters and its time,
`Faults` makes them happen.
"""

from sim.faults.injector import Faults
from sim.faults.kind import Kind
from sim.faults.schedule import Fault, load_faults
from sim.faults.vocabulary import kinds

__all__ = ["Fault", "Faults", "Kind", "kinds", "load_faults"]
