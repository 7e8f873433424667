"""The short benchmarks run to their end, and the others report what they need."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import figure_7
from hbr.core.angles import wrap360
from hbr.evaluation.photographs import load_coil
from rig.catalog import Catalog
from rig.catalog.exchange.tables import write_folder
from rig.catalog.transfer import CatalogSource
from rig.core.clock import SystemClock
from rig.evaluation.experiments import load_catalog, load_experiment
from rig.evaluation.run import run_experiment

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
@pytest.mark.parametrize(("name", "last"), [("bench_cedd", "hbr.describe"), ("bench_views", "in motion")])
def test_short_benchmarks_run_to_their_end(name: str, last: str, tmp_path: Path) -> None:
    assert last in output(name, tmp_path).splitlines()[-1]


@pytest.mark.nightly
def test_views_of_figure_7_have_irregular_angles_that_the_gyro_measured(tmp_path: Path) -> None:
    figure_7.record(tmp_path / "catalog", ("mug-white", "teapot"), seed=1, views=(10, 12))
    with Catalog.open(tmp_path / "catalog", clock=SystemClock(), read_only=True) as catalog:
        for view in catalog.object("teapot").views:
            assert view.imu_deg is not None
            assert view.azimuth_deg == wrap360(-view.imu_deg)
        assert {view.imu_deg == view.encoder_deg for view in catalog.object("teapot").views[1:]} == {False}
        dataset = load_catalog(catalog)
        write_folder(tmp_path / "folder", CatalogSource(catalog))
        exported = load_coil(tmp_path / "folder")
        for own, copied in zip(dataset.objects, exported.objects, strict=True):
            assert 10 <= len(own.photographs) <= 12
            np.testing.assert_array_equal(own.azimuth_deg, copied.azimuth_deg)
        assert dataset.missing is None
        experiment = load_experiment("figure-7", methods="hbr,ahbr", noise="mb", objects="1-2")
        assert experiment.protocol.sigma_deg == 0  # the angles have the gyro's own errors
        results = run_experiment(experiment, dataset, 1, lambda *_: None)
    assert results["settings"]["dataset"]["missing_views"] is None
    assert [method["curve"][3]["hit_rate"] > 0.5 for method in results["methods"]] == [True, True]
