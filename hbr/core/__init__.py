"""Angles, array types and checks that the other packages use."""
