"""Benchmarks: times as ratios to a peer that is measured in the same run."""

import os

# One thread, also if `make bench` does not start the benchmark. NumPy reads the variable when it is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
