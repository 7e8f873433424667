"""The contracts of camera and IMU, which the simulated devices keep to, with Linux's real drivers."""

import sys

import pytest

from tests.kernel.guest_bench import GuestBench
from tests.kernel.machine import PROJECT

pytestmark = [pytest.mark.kernel, pytest.mark.timeout(600)]

FILES = "RIG_TEST_CAMERA=/dev/video0 RIG_TEST_I2C=/dev/i2c-1"
PYTEST = f"{sys.executable} -m pytest -p no:cacheprovider -p no:xdist -rs -m kernel --tb=short"


def test_a_camera_at_a_device_file_keeps_to_the_contract(bench: GuestBench) -> None:
    ended = bench.start_sh(f"{FILES} {PYTEST} tests/contract/test_camera.py", folder=str(PROJECT)).wait(400)
    assert ended.code == 0, ended.output
    assert "skipped" not in ended.output


def test_an_imu_at_a_device_file_keeps_to_the_contract(bench: GuestBench) -> None:
    chosen = "-k 'test_samples_come_once or test_gravity'"  # others move the world, which is in another program
    ended = bench.start_sh(f"{FILES} {PYTEST} {chosen} tests/contract/test_imu.py", folder=str(PROJECT)).wait(300)
    assert ended.code == 0, ended.output
    assert "2 passed" in ended.output
