import pytest

from tests.sim.servo.servo_bench import Line


@pytest.fixture
def line() -> Line:
    """One XL430 with id 1 at 1 MBd on a perfect bench."""
    line = Line()
    line.add()
    return line
