"""The contracts of camera and IMU, which the simulated devices keep to, with Linux's real drivers."""

import pytest

from tests.kernel.guest_bench import GuestBench
from tests.kernel.test_first_day import CAMERA

pytestmark = [pytest.mark.kernel, pytest.mark.timeout(600)]

OPTIONS = (
    *("-p", "no:cacheprovider", "-p", "no:xdist", "-rs", "-m", "kernel", "--tb=short"),
    *("-W", "ignore::pytest.PytestAssertRewriteWarning"),  # the program starts with the modules imported
)
CHOSEN = "test_camera or test_samples_come_once or test_gravity"
"""Other tests of the IMU move the world, which is in another program."""


def test_camera_and_imu_at_device_files_keep_to_the_contracts(bench: GuestBench) -> None:
    code = f"""
import os, pytest
os.environ |= {{"RIG_TEST_CAMERA": "{CAMERA}", "RIG_TEST_I2C": "{bench.i2c_bus}"}}
raise SystemExit(pytest.main([*{OPTIONS}, "-k", "{CHOSEN}", "tests/contract"]))
"""
    ended = bench.python(code, timeout=500)
    assert ended.code == 0, ended.output
    assert "skipped" not in ended.output
    assert "16 passed" in ended.output, ended.output
