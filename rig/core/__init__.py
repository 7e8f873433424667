"""Modules that all other packages of `rig` use: clock, errors, files, processes."""
