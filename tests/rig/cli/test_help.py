"""The help of every command has an example and is fast."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator

import pytest
import typer
from typer.testing import CliRunner

from rig.cli.main import SECTIONS, app
from rig.cli.ui.exit_codes import EXIT_CODES
from rig.core.errors import error_kinds

RIG = [sys.executable, "-c", "from rig.cli.main import main; main()"]


def commands(group: object, words: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    inner = getattr(group, "commands", None)
    if inner is None:
        yield words
        return
    for name, command in inner.items():
        if not command.hidden:  # a second name of another command
            yield from commands(command, (*words, name))


COMMANDS = sorted(commands(typer.main.get_command(app)))


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_every_command_has_an_example_that_begins_with_its_name(words):
    done = CliRunner().invoke(app, [*words, "--help"], env={"COLUMNS": "100"})
    assert done.exit_code == 0
    text = " ".join(done.output.split())
    assert f"Example: rig {' '.join(words)}" in text


def test_every_error_has_an_exit_code_that_the_help_explains():
    assert {kind.code // 100 for kind in error_kinds()} <= EXIT_CODES.keys()
    shown = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "100"}).output
    for code, meaning in EXIT_CODES.items():
        assert f"{code:>3}  {meaning}" in shown


def test_help_imports_no_heavy_module():
    heavy = {"numpy", "cv2", "scipy", "sqlalchemy", "pydantic", "jinja2", "tomlkit", "rich"}
    code = (
        "import sys; sys.argv = ['rig', '--help']\n"
        "from rig.cli.main import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        f"print('HEAVY', sorted({heavy} & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "HEAVY []" in done.stdout


@pytest.mark.parametrize("arguments", ["--no-color enroll --help", "config show servo --no-color"])
def test_no_color_works_at_any_position(arguments):
    environment = {**os.environ, "FORCE_COLOR": "1", "TERM": "xterm-256color", "COLUMNS": "90"}
    environment.pop("NO_COLOR", None)
    done = subprocess.run([*RIG, *arguments.split()], env=environment, capture_output=True, text=True)
    assert done.returncode == 0
    assert "\x1b[3" not in done.stdout + done.stderr  # no colour; bold and dim are allowed


@pytest.mark.nightly
def test_terminal_without_unicode_shows_question_marks(tmp_path):
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    done = subprocess.run(
        [*RIG, "goto", "20", "--bench", "sim"], env=environment, cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0
    assert "(asked 20.00?)" in done.stdout


def test_help_begins_with_the_ten_commands_of_a_day_and_names_every_command_once():
    shown = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "120"}).output
    sections = re.findall(r"^([A-Z][\w -]+):$", shown, re.MULTILINE)
    assert sections == [*SECTIONS, "Options"]  # no command is without a section
    assert sections[0] == "Start here"
    assert len(SECTIONS["Start here"]) == 10
    listed = re.findall(r"^  ([a-z][a-z-]+) +[A-Z]", shown, re.MULTILINE)
    assert listed == [name for names in SECTIONS.values() for name in names]


def test_help_of_a_group_cuts_no_sentence():
    for group in {words[0] for words in COMMANDS if len(words) > 1}:
        shown = CliRunner().invoke(app, [group, "--help"], env={"COLUMNS": "80"}).output
        assert not re.search(r"\w\.\.\.$", shown, re.MULTILINE), group


def test_names_of_commands_are_completed_without_importing_them():
    code = (
        "import sys; sys.argv = ['rig']\n"
        "from rig.cli.main import main\n"
        "try: main()\n"
        "finally: print('\\nnumpy' if 'numpy' in sys.modules else '')\n"
    )
    asked = {**os.environ, "_RIG_COMPLETE": "complete_bash", "COMP_WORDS": "rig s", "COMP_CWORD": "1"}
    done = subprocess.run([sys.executable, "-c", code], env=asked, capture_output=True, text=True)
    assert done.stdout.split() == ["status", "stop", "serve", "setup", "snapshot", "servo", "sim-bench"]
