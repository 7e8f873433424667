"""The enrolled views as arrays, and properties of objects from them: symmetry and similar objects."""
