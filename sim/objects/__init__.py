"""Things that can stand on the simulated platter: a built-in shelf, and photographs of real ones."""
