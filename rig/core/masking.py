"""Passwords and tokens are never shown: each is replaced by `HIDDEN`."""

import re
from collections.abc import Mapping
from typing import Any, Final

HIDDEN: Final = "***"
_NAMES: Final = r"(?:[\w.-]*(?:password|passwd|token|secret|signature|credential)|[\w.-]*[\w-]key)"
_SECRET_NAME: Final = re.compile(_NAMES, re.IGNORECASE)
_SETTING: Final = re.compile(rf"^({_NAMES}=).+", re.IGNORECASE)
_ASSIGNED: Final = re.compile(
    rf"((?<![?&;\w.-]){_NAMES}[\"']?\s*=\s*)(\"[^\"\n]*\"|'[^'\n]*'|[^\s,}}\]][^\s,}}\]\"']*)", re.IGNORECASE
)
_IN_QUERY: Final = re.compile(rf"([?&;]{_NAMES}=)[^&;\s\"']+", re.IGNORECASE)
_WHOLE_URL: Final = re.compile(r"([\w.-]+=)?[\w+.-]+://")
_USER: Final = re.compile(r"://[^\s/:@\"']*:")


def masked(value: Any) -> Any:
    """Return a value with `HIDDEN` in the place of passwords and tokens.

    They are found in URLs, in assignments as in TOML and in command lines, and under names such as ``api_token`` in
    mappings. Rather too much is hidden than too little. Values other than texts, lists, tuples and mappings are
    returned unchanged.
    """
    if isinstance(value, str):
        return _masked_text(value)
    if isinstance(value, Mapping):
        return {key: HIDDEN if item and _is_secret(key, item) else masked(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        items = [masked(item) for item in value]
        return items if isinstance(value, list) else tuple(items)
    return value


def _is_secret(name: object, value: object) -> bool:
    return isinstance(value, str) and _SECRET_NAME.fullmatch(str(name)) is not None


def _masked_text(text: str) -> str:
    if "://" in text and "@" in text:
        # In a text that is a URL, or the setting of one, spaces belong to the password.
        text = _masked_url(text) if _WHOLE_URL.match(text) else re.sub(r"\S+", lambda word: _masked_url(word[0]), text)
    if "=" in text:
        text = _IN_QUERY.sub(rf"\1{HIDDEN}", _SETTING.sub(rf"\1{HIDDEN}", text))
        text = _ASSIGNED.sub(lambda found: found[1] + (f'"{HIDDEN}"' if found[2][0] in "\"'" else HIDDEN), text)
    return text


def _masked_url(text: str) -> str:
    user, end = _USER.search(text), text.rfind("@")
    return text if user is None or end < user.end() else f"{text[: user.end()]}{HIDDEN}{text[end:]}"
