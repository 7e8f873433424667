"""Fixtures for the tests of calibrations."""

from pathlib import Path

import pytest


@pytest.fixture
def rig(rig):
    """Return the function `rig` with frames of the whole size, which the board's corners need."""
    Path("rig.toml").write_text(
        'default_bench = "sim"\ncalibration_dir = "calibrations"\n[catalog]\npath = "catalog"\n'
    )
    return rig
