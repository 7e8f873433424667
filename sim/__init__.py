"""The simulated bench: byte-true devices below the real drivers, a rendered world, a virtual clock, and faults."""
