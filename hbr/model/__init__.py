"""The enrolled views as arrays, and what they say about an object: its symmetry and similar objects."""
