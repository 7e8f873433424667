"""The simulated rig head: the firmware itself, built for this computer."""
