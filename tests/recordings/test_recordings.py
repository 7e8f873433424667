"""The simulator has the errors of real devices, within the limits of the page that compares them."""

from collections.abc import Callable

import pytest

from tests.recordings.fits import FILES, PAGE, RECORDED, ROWS, SIMULATED, Fit, fits, table

UPDATE = "run python -m tests.recordings.fits, and read the difference"


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_simulator_differs_from_the_recordings_within_the_limits(row):
    real, simulated = fits()[row.name]
    if row.limit is not None:
        assert simulated == pytest.approx(real, rel=row.limit)


def test_page_shows_the_stored_fits():
    assert "\n".join(table()) in PAGE.read_text(), UPDATE


@pytest.mark.nightly
@pytest.mark.parametrize("fit", SIMULATED)
def test_simulator_fits_as_stored(fit: Callable[[], Fit]):
    assert_stored(fit(), 1)


@pytest.mark.skipif(not FILES.is_dir(), reason="the recordings are not beside the project (../shared/data/recordings)")
@pytest.mark.parametrize("fit", RECORDED)
def test_recordings_fit_as_stored(fit: Callable[[], Fit]):
    assert_stored(fit(), 0)


def assert_stored(found: Fit, column: int) -> None:
    stored = {name: fits()[name][column] for name in found}
    assert found == pytest.approx(stored, rel=1e-3), UPDATE
