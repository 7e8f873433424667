"""Tables in a pipe: aligned columns, one line for each row, all of its text."""

import pytest

from rig.cli.ui.present import print_table


def test_rows_in_a_pipe_are_aligned_and_complete(capsys: pytest.CaptureFixture[str]) -> None:
    rows = [["mug", "72", ""], ["漢字 [bold]", "7", "x" * 300], ["\x1b[31mred", "", "end"]]
    print_table(("name", "views", "note"), rows, right=("views",))
    assert capsys.readouterr().out.splitlines() == [
        "name           views  note",
        "mug               72",
        f"漢字 [bold]        7  {'x' * 300}",
        "\\u001b[31mred         end",
    ]
