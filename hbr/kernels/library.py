"""The compiled library, if there is one that fits."""

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from hbr.kernels.compile import LIBRARY, sources_digest

#: Variable of the environment; the value ``numpy`` switches the compiled part off.
SWITCH: Final = "HBR_KERNELS"

_POINTER, _INTEGER, _REAL = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
_SIGNATURES: Final[dict[str, tuple[Any, ...]]] = {
    "hbr_cedd": (_POINTER, *[_INTEGER] * 5, _POINTER, _POINTER, _POINTER),
    "hbr_byte_squares": (_POINTER, *[_INTEGER] * 3, _POINTER),
    "hbr_tanimoto": (_POINTER, _INTEGER, _INTEGER, _POINTER, _INTEGER, _POINTER, _INTEGER, _INTEGER, _POINTER),
    "hbr_tanimoto_top": (_POINTER, _POINTER, _INTEGER, _INTEGER, _POINTER, _INTEGER, _INTEGER, _POINTER, _POINTER),
    "hbr_support": (
        *[_POINTER] * 3, _INTEGER, _POINTER, _POINTER, _REAL, _REAL, _INTEGER, _POINTER, _INTEGER, _POINTER,
    ),
    "hbr_layers": (_POINTER, _INTEGER),
    "hbr_shrink": (_POINTER, *[_INTEGER] * 4, _POINTER, _POINTER),
    "hbr_average": (_POINTER, *[_INTEGER] * 3, _POINTER, _POINTER, _INTEGER, *[_POINTER] * 4),
    "hbr_nearest_view": (*[_POINTER] * 5, _INTEGER, _POINTER, _INTEGER, _POINTER, _POINTER),
    "hbr_paths": (
        _POINTER, _INTEGER, _INTEGER, _INTEGER, _POINTER, _INTEGER, *[_POINTER] * 3, _REAL, *[_POINTER] * 7,
    ),
}  # fmt: skip

# those that this process may use: in a container, fewer than the computer has
_CORES: Final = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

THREADS: Final = min(_CORES, 4)
"""Threads of one large computation. More of them would wait for the memory or for the interpreter."""

_forced_off = False


def library() -> ctypes.CDLL | None:
    """Return the compiled kernels; None if NumPy does their work."""
    return None if _forced_off else _loaded()


@lru_cache(maxsize=1)
def _loaded() -> ctypes.CDLL | None:
    return None if os.environ.get(SWITCH) == "numpy" else load(LIBRARY)


def load(path: Path) -> ctypes.CDLL | None:
    """Load a library; None if it is missing, of another machine, or not compiled from the sources beside it."""
    if ctypes.sizeof(_POINTER) != 8 or not path.exists():  # NumPy's indices have 64 bits, as in C, only there
        return None
    try:
        found = ctypes.CDLL(str(path))
        compiled_from = ctypes.string_at(ctypes.addressof(ctypes.c_char.in_dll(found, "hbr_sources"))).decode()
        if compiled_from != sources_digest(path.parent):
            return None
        for name, types in _SIGNATURES.items():
            function = getattr(found, name)
            function.argtypes, function.restype = types, None
    except (OSError, ValueError, AttributeError):
        return None
    return found


def run(name: str, *arguments: Any) -> bool:
    """Run a kernel, and return True; False without the compiled library.

    Contiguous arrays are passed by their addresses.
    """
    found = library()
    if found is None:
        return False
    getattr(found, name)(*[address(one) if isinstance(one, np.ndarray) else one for one in arguments])
    return True


@contextmanager
def without_library() -> Iterator[None]:
    """Let NumPy do the work in a ``with`` block: for tests and benchmarks."""
    global _forced_off
    before, _forced_off = _forced_off, True
    try:
        yield
    finally:
        _forced_off = before


_first_byte, _address_of = ctypes.c_char.from_buffer, ctypes.addressof


def address(array: "np.ndarray[Any, Any]") -> int:
    """Return where the data of an array begins; the array must live as long as the pointer is used."""
    try:
        return _address_of(_first_byte(array.data))  # takes a third of the time of `array.ctypes`
    except (TypeError, ValueError, BufferError):  # read-only, empty, or with gaps
        found: int = array.__array_interface__["data"][0]
        return found
