"""The tests."""

import os
import platform
import sys
from typing import Final

# OpenCV, OpenBLAS and NumPy choose their code by the processor, and with AVX-512 they round other last digits. A search
# amplifies them: a pixel at a threshold changes a silhouette. Tests that compare what a search prints need the same
# digits on every processor, and so do the programs that they start. The libraries read this when they are imported.
DIGITS_ARE_THOSE_STORED: Final = platform.machine() in ("x86_64", "AMD64") and (
    "numpy" not in sys.modules or "NPY_DISABLE_CPU_FEATURES" in os.environ
)
"""Not on other processors, and not if a plug-in of pytest imported NumPy before, in a run without workers."""
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
if platform.machine() in ("x86_64", "AMD64"):
    os.environ.setdefault("OPENCV_CPU_DISABLE", "AVX512-SKX")
    os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")
    os.environ.setdefault("NPY_DISABLE_CPU_FEATURES", "X86_V4 AVX512_ICL AVX512_SPR")
