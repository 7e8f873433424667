"""The checks of `rig doctor`: the connected devices, their state, and fixes. No check moves anything."""
