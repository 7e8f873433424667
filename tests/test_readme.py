"""The README promises nothing that does not run."""

import re
import subprocess
import sys
from pathlib import Path

from typer.testing import CliRunner

from rig.cli.main import app

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_library_example_runs_and_finds_the_object(tmp_path):
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1].startswith("teapot ")


def test_every_command_and_option_that_is_shown_exists():
    shown = re.findall(r"^ {4}rig ([^#\n]+)|`rig ([^`\n]+)`", README, re.MULTILINE)
    assert len(shown) >= 8
    for indented, quoted in shown:
        words = (indented or quoted).split()
        name = words[:2] if words[0] in ("catalog", "calibrate") else words[:1]
        done = CliRunner().invoke(app, [*name, "--help"], env={"COLUMNS": "200"})
        assert done.exit_code == 0, words
        for option in re.findall(r"--[a-z-]+", " ".join(words)):
            assert option in done.output, words


def test_every_file_that_is_linked_is_there():
    for link in re.findall(r"\]\((?!http)([^)#]+)\)", README):
        assert (ROOT / link).exists(), link


def test_the_toml_example_is_a_valid_configuration(tmp_path):
    from rig.config import load_config

    (toml,) = re.findall(r"```toml\n(.*?)```", README, re.DOTALL)
    (tmp_path / "rig.toml").write_text(re.sub(r"(?m)^   ", "", toml), encoding="utf-8")
    assert load_config(tmp_path / "rig.toml").servo.port == "/dev/ttyUSB0"
