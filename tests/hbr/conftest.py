import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def rig_test_data() -> Path:
    default = Path(__file__).parents[2] / ".." / "shared" / "data"
    folder = Path(os.environ.get("RIG_TEST_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"test data not found at {folder}; set RIG_TEST_DATA")
    return folder
