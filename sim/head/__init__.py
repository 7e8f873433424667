"""The simulated rig head: the firmware itself, on this computer or in an emulated microcontroller."""
