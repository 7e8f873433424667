"""Formats of other programs, and bundles: what objects are exported to and imported from."""
