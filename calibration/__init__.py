"""Procedures that measure the errors of the bench."""
