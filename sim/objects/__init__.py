"""Objects for the simulated platter: built-in ones, and photographs of real ones."""
