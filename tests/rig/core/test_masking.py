"""Passwords and tokens are hidden, whatever the text around them is."""

import pytest

from rig.core.errors import CatalogError
from rig.core.masking import masked


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("postgresql+psycopg://ada:pw@host/rig", "postgresql+psycopg://ada:***@host/rig"),
        ("postgresql://:pw@host", "postgresql://:***@host"),
        ("catalog.url=postgresql://ada:p'w \"x@host", "catalog.url=postgresql://ada:***@host"),
        ("rig serve --set catalog.url=a://b:pw@c --seed 3", "rig serve --set catalog.url=a://b:***@c --seed 3"),
        ("'rtsp://me:p/w:@pw@10.0.0.9/live' does not answer.", "'rtsp://me:***@10.0.0.9/live' does not answer."),
        ("s3://bucket/rig?secret_key=p,w&size=2", "s3://bucket/rig?secret_key=***&size=2"),
        ("postgresql://host/rig?user=ada&password=pw", "postgresql://host/rig?user=ada&password=***"),
        ("bench.mine.api_token=p w", "bench.mine.api_token=***"),
        ('users = [{ name = "ada", password = "p w" }]  # two', 'users = [{ name = "ada", password = "***" }]  # two'),
        ("password = 'pw", 'password = "***"'),
        ("Write SECTION.KEY=VALUE, e.g. --set identify.max_views=4.", None),
        ("The page http://127.0.0.1:8420/ is that of ada@host.", None),
        ("postgresql+psycopg://rig@/postgres?host=/tmp", None),
        ("s3://bucket/rig", None),
        ("key=3, token", None),
    ],
)
def test_secrets_in_a_text_are_hidden(text: str, shown: str | None) -> None:
    assert masked(text) == (text if shown is None else shown)
    assert masked(masked(text)) == masked(text)


def test_secrets_in_other_values_are_hidden() -> None:
    assert masked({"key": "a", "api_key": "b", "inner": {"Password": "c", "secret": None, "token": 5}}) == {
        "key": "a",
        "api_key": "***",
        "inner": {"Password": "***", "secret": None, "token": 5},
    }
    assert masked(("a://b:c@d", ["x.token=y"], 3)) == ("a://b:***@d", ["x.token=***"], 3)


def test_errors_hide_secrets() -> None:
    error = CatalogError("a://b:pw@c fails.", next_step="Check a://b:pw@c.", evidence={"server": "token=pw"})
    assert "pw" not in f"{error} {error.problem}"


@pytest.mark.parametrize("part", ["a.", "://:", "?a", "a==", "key ", "@://:", "a=@://", "token ", '"', "password", "="])
def test_long_texts_take_no_time(part: str) -> None:
    """A pattern that takes the square of the length needs minutes for these."""
    masked(part * 100_000 + "=@://x")
