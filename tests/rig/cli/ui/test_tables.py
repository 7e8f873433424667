"""Tables in a pipe: aligned columns, one line for each row, all of its text."""

from datetime import UTC, datetime

import pytest

from rig.cli.ui.present import print_table


def test_rows_in_a_pipe_are_aligned_and_complete(capsys: pytest.CaptureFixture[str]) -> None:
    rows = [
        {"name": "mug", "views": 72, "angle_deg": -12.3, "note": "", "more": {"replace": False}},
        {"name": "漢字 [bold]", "views": 7, "angle_deg": None, "note": "x" * 300, "more": {"to_deg": 90.0}},
        {"name": "\x1b[31mred", "views": 0, "angle_deg": 4.0, "note": datetime(2026, 1, 2, tzinfo=UTC), "more": {}},
    ]
    print_table(("name", "views", "angle_deg", "note"), rows)
    print_table(("more",), rows)
    assert capsys.readouterr().out.splitlines() == [
        "name           views  angle_deg  note",
        "mug               72     −12.30  –",
        f"漢字 [bold]        7          –  {'x' * 300}",
        "\\u001b[31mred      0       4.00  2026-01-02 00:00:00",
        *("more", "", "to_deg 90.00", ""),
    ]
