"""Numbers, times and lists in words."""

import ast
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.core.phrases import (
    angle_words,
    budget_words,
    distinct,
    filled,
    in_unit,
    number,
    percent,
    percent_words,
    signed,
)

ROOT = Path(__file__).parents[3]


@given(a=st.floats(0, 45), b=st.floats(0, 45))
def test_different_numbers_read_differently(a: float, b: float) -> None:
    left, right = distinct(a, b)
    assert (left != right) == (a != b) or abs(a - b) < 1e-5
    assert float(left) == pytest.approx(a, abs=0.00501)


def test_percentages_near_0_and_100_are_bounds() -> None:
    shown = [percent_words(probability) for probability in (0.0, 0.0005, 0.5, 0.9995, 1.0)]
    assert shown == ["<0.1 %", "<0.1 %", "50.0 %", ">99.9 %", ">99.9 %"]


def test_zero_has_no_minus_sign() -> None:
    assert [signed(value, 2) for value in (-0.001, 0.0, -0.01, 0.004)] == ["+0.00", "+0.00", "−0.01", "+0.00"]
    assert [angle_words(value) for value in (-0.04, -0.06)] == ["0.0°", "−0.1°"]


def test_angles_have_the_minus_sign() -> None:
    assert angle_words(-540.0, None) == "−540°"
    assert budget_words((-540.0, 540.0)) == "−540° to 540° (−1.50 to +1.50 revolutions)"


def test_templates_are_filled_with_the_minus_sign_and_a_space_before_percent() -> None:
    words = filled(
        "{name}: {change:+.1f}°, {share:.0%}, set sign = {sign}", name="mug-1", change=-2.04, share=0.5, sign=-1
    )
    assert words == "mug-1: −2.0°, 50 %, set sign = -1"
    assert filled("{0.real:.2f} of {1!r}", -1.5, "a-1") == "−1.50 of 'a-1'"
    with pytest.raises(KeyError):
        filled("{missing}")


@given(st.floats(-1e6, 1e6), st.sampled_from(["", ".0f", ".2f", "+.1f", "g", ".3g", ".1%"]))
def test_numbers_are_read_as_they_were_written(value: float, form: str) -> None:
    words = number(value, form)
    assert "-" not in words
    assert re.fullmatch(r"[−+]?[0-9.e+−]+( %)?", words)
    plain = words.replace("−", "-").removesuffix(" %")
    assert float(plain) == float(format(value, form).removesuffix("%"))
    assert float(plain) != 0 or not words.startswith("−")


def test_no_text_has_a_percent_sign_without_a_space() -> None:
    """An f-string does not write a number with "%"; `percent` does, with a space."""
    assert percent(0.5, 0) == "50 %"
    found = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for folder in ("rig", "sim", "calibration", "hbr")
        for path in (ROOT / folder).rglob("*.py")
        if "%}" in (text := path.read_text(encoding="utf-8"))  # parsing all files takes a second
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FormattedValue) and node.format_spec and ast.unparse(node.format_spec).endswith("%'")
    ]
    assert not found


@pytest.mark.parametrize(
    ("words", "unit", "expected"),
    [
        ("12", "mm", "12 mm"),
        ("70", "°", "70°"),
        ("1.5 ± 0.2", "° of tilt", "1.5 ± 0.2° of tilt"),
        ("−3.6", "°/s", "−3.6 °/s"),
        ("[a number, a number]", "°", "[a number, a number] °"),
        ("0.5", "", "0.5"),
    ],
)
def test_degrees_follow_a_number_without_a_space(words: str, unit: str, expected: str) -> None:
    assert in_unit(words, unit) == expected
