"""docs/tutorial/first-search.md: every command runs and ends as the page says."""

import re
import shlex

import pytest
from typer.testing import CliRunner

from rig.cli.main import app
from tests.docs.pages import DOCS

EXIT_CODES = {"identify --set bench.sim.object=camera": 8, "goto 90": 5}


@pytest.mark.nightly
@pytest.mark.parametrize("whole_frames", [False, True])
def test_commands_of_the_tutorial_end_as_it_says(tmp_path, monkeypatch, whole_frames):
    page = (DOCS / "tutorial/first-search.md").read_text(encoding="utf-8")
    (toml,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    small = "[camera]\nwidth = 320\nheight = 240\n[view]\nroi = [40, 0, 240, 240]\n"  # takes less computing
    (tmp_path / "rig.toml").write_text(toml + ("" if whole_frames else small), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    outputs = {}
    for command in re.findall(r"^rig (.*)$", page, re.MULTILINE):
        typed = command if whole_frames else command.replace("--views 12", "--views 8")
        done = CliRunner().invoke(app, shlex.split(typed))
        expected = next((code for start, code in EXIT_CODES.items() if command.startswith(start)), 0)
        assert done.exit_code == expected, f"rig {command}\n{done.output}"
        outputs[command] = done.output
    assert "mug-white" in outputs["enroll mug-star --views 12"]  # similar objects
    assert "\nmug-white, rotated" in outputs["identify --set bench.sim.object=mug-white --seed 14 --save-run run"]
    assert "\nUnknown object" in outputs["identify --set bench.sim.object=camera"]
