"""A simulated bench with a life of its own: one world in real time, which several programs use at once.

Decision: docs/decisions/0037.
"""
