"""The protection of the table: the state machine, limits, motion checks, and the state that survives a restart."""
