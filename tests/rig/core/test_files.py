"""Files from other users are read without waiting, and only up to a limit."""

import os
from pathlib import Path

import pytest

from rig.core.errors import UsageError
from rig.core.files import json_values, read
from rig.plans.tray import read_tray


def test_only_regular_files_within_the_limit_are_read(tmp_path):
    file = tmp_path / "file"
    file.write_bytes(b"12345")
    os.mkfifo(tmp_path / "pipe")
    assert read(file, max_bytes=5) == b"12345"
    with pytest.raises(OSError, match="larger than 4 bytes"):
        read(file, max_bytes=4)
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(OSError, match="not a regular file"):
            read(path, max_bytes=5)
    with pytest.raises(OSError, match=r"directory|folder"):
        read(tmp_path, max_bytes=5)
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "none", max_bytes=5)


def test_lists_of_objects_are_regular_files(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(UsageError) as caught:
            read_tray(path)
        assert caught.value.evidence == {"reason": "it is not a regular file"}


@pytest.mark.parametrize("content", ["[" * 100_000, "9" * 5000, "[NaN]", "[-Infinity]", b"\xff", "[1"])
def test_nonstandard_json_is_a_value_error(content):
    with pytest.raises(ValueError, match=r"."):
        json_values(content)
