"""A simulated bench in its own process: one world in real time, which several programs use at once.

Decision: docs/decisions/0001.
"""
