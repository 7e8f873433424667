"""Characters that control a terminal or change the direction of text. They can hide text, or type answers."""

import re
from typing import Final

_CONTROL: Final = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f"  # C0 except tab and line feed, DEL, C1
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # direction of text, Unicode UAX #9
    "\u2028\u2029]"  # line and paragraph separator
)


def neutral(text: str) -> str:
    r"""Return a text without control characters and changes of direction: each becomes ``\u`` and its code."""
    return _CONTROL.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def has_control_characters(text: str) -> bool:
    """Return whether `neutral` would change a text."""
    return _CONTROL.search(text) is not None
