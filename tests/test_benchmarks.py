"""The short benchmarks run to their end, and the others report what they need."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def output(name: str, folder: Path) -> str:
    """Run a benchmark in a folder; return what it prints."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    program = [sys.executable, "-m", f"benchmarks.{name}"]
    done = subprocess.run(
        program, cwd=folder, env=environment, timeout=100, check=True, capture_output=True, encoding="utf-8"
    )
    return done.stdout


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("name", "last"), [("bench_cedd", "hbr.describe"), ("bench_servo", "repeated answer"), ("bench_views", "in motion")]
)
def test_short_benchmarks_run_to_their_end(name: str, last: str, tmp_path: Path) -> None:
    assert last in output(name, tmp_path).splitlines()[-1]
