"""Numbers, times and lists as people read them."""

from collections.abc import Sequence
from enum import StrEnum
from string import Formatter
from typing import Any, Self


class Worded(StrEnum):
    """A code that records contain, and the text that people read: a template for `filled`."""

    words: str

    def __new__(cls, value: str, words: str = "") -> Self:
        member = str.__new__(cls, value)
        member._value_, member.words = value, words
        return member


def whole(text: str) -> int | None:
    """Return the number of a text of up to 15 digits; None for any other text. Python rejects thousands of digits."""
    return int(text) if text.isdecimal() and len(text) <= 15 else None


def percent_words(probability: float) -> str:
    """Return a probability in percent; "<0.1 %" and ">99.9 %" at the ends."""
    if probability > 0.999:
        return ">99.9 %"
    return "<0.1 %" if probability < 0.001 else percent(probability)


def percent(share: float, decimals: int = 1) -> str:
    """Return a share in percent: "2.0 %"."""
    return f"{100 * share:.{decimals}f} %"


def duration_words(seconds: float) -> str:
    """Return a time as people read it: "43 s", "2 min 05 s", "1 h 20 min"."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def sentence(words: str) -> str:
    """Return ``words`` with a capital and a full stop."""
    return f"{words[:1].upper()}{words[1:]}."


def azimuth_words(azimuth_deg: float) -> str:
    """Return an azimuth to a tenth of a degree, from 0.0 to 359.9, without its sign for degrees."""
    return f"{round(azimuth_deg, 1) % 360:.1f}"


def counted(n: int, noun: str) -> str:
    """Return "1 view", "2 views"."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def angle_words(angle_deg: float, decimals: int | None = 1) -> str:
    """Return an angle of the table: "−12.5°"; without decimals, the digits that it has: "−540°"."""
    return f"{number(angle_deg, 'g' if decimals is None else f'.{decimals}f')}°"


def angle_range(limits_deg: tuple[float, float], decimals: int | None = None) -> str:
    """Return a range of the table's angles: "−540° to 540°"."""
    return " to ".join(angle_words(limit_deg, decimals) for limit_deg in limits_deg)


def budget_words(limits_deg: tuple[float, float]) -> str:
    """Return a cable budget: "−540° to 540° (−1.50 to +1.50 revolutions)"."""
    revolutions = " to ".join(signed(limit_deg / 360, 2) for limit_deg in limits_deg)
    return f"{angle_range(limits_deg)} ({revolutions} revolutions)"


def joined(items: Sequence[str], conjunction: str = "and") -> str:
    """Return items as an English list: "a, b and c"."""
    return f"{', '.join(items[:-1])} {conjunction} {items[-1]}" if len(items) > 1 else "".join(items)


def short(words: str, letters: int) -> str:
    """Return words cut to a number of letters, the last of them "…"."""
    return words if len(words) <= letters else f"{words[: letters - 1]}…"


def distinct(a: float, b: float, *, decimals: int = 2) -> tuple[str, str]:
    """Return two numbers with enough decimals to show their difference: at least ``decimals``, at most five."""
    enough = next((d for d in range(decimals, 5) if f"{a:.{d}f}" != f"{b:.{d}f}"), 5) if a != b else decimals
    return f"{a:.{enough}f}", f"{b:.{enough}f}"


def signed(value: float, decimals: int) -> str:
    """Return a number with its sign, a real minus."""
    return number(value, f"+.{decimals}f")


def number(value: float, form: str) -> str:
    """Return a number in a format of Python, with a real minus, no minus of a zero, and a space before "%"."""
    words = format(value, form)
    if words.startswith("-") and not words.strip("-0.%"):
        words = format(0.0, form)
    return words.replace("-", "−").replace("%", " %")


def in_unit(words: str, unit: str) -> str:
    """Return words with a unit: "12 mm", "70°", "a list of numbers °"; "1.5" without one."""
    degrees = words[-1:].isdigit() and (unit == "°" or unit.startswith("° "))
    return f"{words}{unit}" if degrees else f"{words} {unit}".rstrip()


def filled(template: str, *values: object, **named: object) -> str:
    """Return a template of `str.format` with its values; numbers with a format are written by `number`."""
    return _FILLER.vformat(template, values, named)


class _Filler(Formatter):
    def format_field(self, value: Any, format_spec: str) -> str:
        """Write a number for people. A number without a format is a setting, which is typed: "imu.sign = -1"."""
        if format_spec and isinstance(value, int | float):
            return number(value, format_spec)
        return format(value, format_spec)


_FILLER = _Filler()
