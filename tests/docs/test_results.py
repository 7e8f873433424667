"""What the page of results says about the paper: L. Czúni and M. Rashad, Sensors 2018, 18(3), 801."""

import re

import pytest

from hbr.drawing.noise import GN_VARIANCE, Noise
from tests.docs.pages import DOCS

PAGE = (DOCS / "results.md").read_text(encoding="utf-8")
TABLE_1 = {
    2: (94.4, 78.8, 84.8, 69.2, 82.4, 69.2),
    4: (98, 90.4, 93.6, 80, 89.6, 80.4),
    6: (98.4, 94.4, 95.6, 85.6, 92.4, 86),
    8: (99.2, 96.8, 96, 88.8, 93.6, 89.6),
}
"""Hit rates of HBR by the number of views: DF-UB, DF-TB, MB-UB, MB-TB, GN-UB, GN-TB."""


def test_table_1_is_that_of_the_paper() -> None:
    section = PAGE.partition("### Table 1 of the paper\n")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (\d) \|(.+)\|$", section, re.MULTILINE)
    assert {int(views): tuple(map(float, cells.split("|"))) for views, cells in rows} == TABLE_1
    assert "not available" not in section


def test_both_readings_of_the_gaussian_noise_are_measured() -> None:
    section = PAGE.partition("### Two readings of the Gaussian noise\n")[2].partition("\n## ")[0]
    by_the_letter = Noise.parse(*set(re.findall(r"--noise (\S+)", section)))
    assert by_the_letter.gaussian_variance**0.5 == pytest.approx(0.012)  # the standard deviation that the paper names
    assert f"GN on this page has the variance {GN_VARIANCE}" in section
    rows = re.findall(r"\| (variance|standard deviation) 0\.012 \|", section)
    assert rows == ["variance", "standard deviation"] * 5
    assert "The noise is the paper's" not in PAGE
