"""A bench: servo, IMU, camera and table together, opened by name."""

from rig.bench.bench import (
    Bench,
    BenchKind,
    Placer,
    bench_kind,
    bench_names,
    calibrate,
    check_config,
    open_bench,
    open_servo,
)

__all__ = [
    "Bench",
    "BenchKind",
    "Placer",
    "bench_kind",
    "bench_names",
    "calibrate",
    "check_config",
    "open_bench",
    "open_servo",
]
