"""What calibrations found out about a bench: dated facts, their store, and how they take effect."""

from rig.facts.fact import Estimate, Fact
from rig.facts.force import put_in_force
from rig.facts.store import FactStore, Standing, State, apparatus

__all__ = ["Estimate", "Fact", "FactStore", "Standing", "State", "apparatus", "put_in_force"]
