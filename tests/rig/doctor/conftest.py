"""A bench that is not open, for the tests of checks and scans."""

import pytest

from tests.rig.doctor.doctor_parts import unopened


@pytest.fixture
def bench():
    with unopened() as bench:
        yield bench
