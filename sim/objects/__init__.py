"""Objects for the simulated platter, as data, and what draws them."""
