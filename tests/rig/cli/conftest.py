"""A catalog with two imported objects."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result
from typer.testing import CliRunner

from rig.cli.main import app
from tests.rig.cli.noise_photographs import photographs

Rig = Callable[..., Result]


@pytest.fixture(scope="session")
def two_objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with photographs of two objects and their catalog."""
    folder = tmp_path_factory.mktemp("two")
    photographs(folder / "photographs", "mug", "tin")
    catalog = ("--bench", "sim", "--set", f"catalog.path={folder / 'catalog'}")
    done = CliRunner().invoke(app, ["import", str(folder / "photographs"), "--label", "kitchen", *catalog])
    assert done.exit_code == 0, done.output
    return folder


@pytest.fixture
def two(rig: Rig, tmp_path: Path, two_objects: Path) -> Rig:
    """The same with two objects in the catalog."""
    shutil.copytree(two_objects, tmp_path, dirs_exist_ok=True)
    return rig
