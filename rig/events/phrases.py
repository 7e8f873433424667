"""Numbers, times and lists as people read them."""

from collections.abc import Iterable, Sequence


def percent_words(probability: float) -> str:
    """Return a probability in percent; "below 0.1 %" and "above 99.9 %" at the ends."""
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


def angle_words(angle_deg: float, decimals: int = 1) -> str:
    """Return an angle of the table: "−12.5°"."""
    return f"{round(angle_deg, decimals) + 0.0:.{decimals}f}°".replace("-", "−")  # + 0.0 removes the sign of a zero


def joined(items: Sequence[str], conjunction: str = "and") -> str:
    """Return items as an English list: "a, b and c"."""
    return f"{', '.join(items[:-1])} {conjunction} {items[-1]}" if len(items) > 1 else "".join(items)


def short(words: str, letters: int) -> str:
    """Return words cut to a number of letters, the last of them "…"."""
    return words if len(words) <= letters else f"{words[: letters - 1]}…"


def listed(items: Iterable[str]) -> str:
    """Return distinct items, in the order of their first appearance, separated by semicolons."""
    return "; ".join(dict.fromkeys(items))


def distinct(a: float, b: float, *, decimals: int = 2) -> tuple[str, str]:
    """Return two numbers with enough decimals to show their difference: at least ``decimals``, at most five."""
    enough = next((d for d in range(decimals, 5) if f"{a:.{d}f}" != f"{b:.{d}f}"), 5) if a != b else decimals
    return f"{a:.{enough}f}", f"{b:.{enough}f}"


def signed(value: float, decimals: int) -> str:
    """Return a number with its sign, a real minus."""
    return f"{round(value, decimals) + 0.0:+.{decimals}f}".replace("-", "−")  # + 0.0 removes the sign of a zero
