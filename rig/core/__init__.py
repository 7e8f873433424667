"""Parts that all rooms use: clock, errors, files, processes."""
