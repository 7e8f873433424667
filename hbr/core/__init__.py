"""Angles, array types and checks that every room uses."""
