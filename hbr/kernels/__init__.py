"""Compiled kernels in C, with the same bits as their references in NumPy, which are the fallback.

Decision: docs/decisions/0021.
"""

from hbr.kernels.library import library, without_library

__all__ = ["library", "without_library"]
