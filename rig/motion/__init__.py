"""Moves the table, and explains why a motion failed."""
