"""No text from outside controls the terminal, and output that cannot be written is an error with a next step."""

import io
import json
import os
import re
import subprocess
import sys
import unicodedata
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.table import Table
from rich.text import Text
from typer.testing import CliRunner

from rig.cli.main import app
from rig.cli.ui.command import show_error
from rig.cli.ui.present import console, show_progress
from rig.cli.ui.settings import Settings
from rig.cli.ui.terminal import guarded_output
from rig.core.control_characters import neutral
from rig.core.errors import CatalogError
from tests.fuzzing import fuzz_settings

RIG = [sys.executable, "-c", "from rig.cli.main import main; main()"]
BIDI = "\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"
ATTACKS = ["\x1b[2J", "\x1b]0;title\x07", "\x9b31m", "\x1b[8mhidden", "a\rb", "\x7f\b\b", *BIDI]
TEXT = st.text(st.one_of(st.sampled_from("".join(ATTACKS) + "[]m\n\t"), st.characters(exclude_categories=["Cs"])))


def is_safe(text: str) -> bool:
    return not any((unicodedata.category(c) == "Cc" and c not in "\n\t") or c in BIDI for c in text)


def shown(monkeypatch, show) -> tuple[str, str]:
    """Return what ``show`` writes to the guarded standard output and standard error."""
    out, err = io.StringIO(newline=""), io.StringIO(newline="")
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", out)
        patch.setattr(sys, "stderr", err)
        with guarded_output():
            show()
    return out.getvalue(), err.getvalue()


@fuzz_settings()
@given(TEXT)
def test_neutral_text_has_no_control_characters_and_loses_nothing(text):
    done = neutral(text)
    assert is_safe(done)
    assert re.sub(r"\\u([0-9a-f]{4})", lambda found: chr(int(found[1], 16)), done) == re.sub(
        r"\\u([0-9a-f]{4})", lambda found: chr(int(found[1], 16)), text
    )
    if is_safe(text) and not set(text) & set("\u2028\u2029"):
        assert done == text


@fuzz_settings(0.2)
@given(TEXT)
def test_everything_that_a_command_prints_is_neutral(text):
    def show():
        print(text)
        print(f"Note: {text}", file=sys.stderr)
        show_error(CatalogError(text, next_step=text, evidence={"name": text, "list": [text]}), Settings())
        screen = console()
        screen.print(text, markup=False)
        table = Table(text)
        table.add_row(Text(text))
        screen.print(table)
        Settings().print_json({"label": text})

    with pytest.MonkeyPatch.context() as patch:
        out, err = shown(patch, show)
    assert is_safe(out)
    assert is_safe(err)
    assert json.loads(out.splitlines()[-1]) == {"label": text}  # JSON stays JSON


@pytest.mark.parametrize("attack", ATTACKS)
def test_terminal_gets_only_the_colors_of_rich(attack, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.delenv("NO_COLOR", raising=False)
    out, _ = shown(monkeypatch, lambda: console().print(Text(f"a{attack}b", style="bold")))
    assert out.startswith("\x1b[1m")
    assert is_safe(re.sub(r"\x1b\[[01]m", "", out))


def test_mistaken_arguments_are_neutral_and_with_json_an_object():
    done = CliRunner().invoke(app, ["\x1b[31mnix\u202e", "--json"])
    assert done.exit_code == 2
    assert is_safe(done.output)
    (line,) = done.stdout.splitlines()
    assert json.loads(line)["code"] == 200
    assert "--help" in json.loads(line)["next_step"]
    deeper = CliRunner().invoke(app, ["catalog", "show", "--nix", "--json"])
    assert json.loads(deeper.stdout)["detail"].startswith("No such option: --nix")
    assert CliRunner().invoke(app, ["catalog", "show", "--nix"]).stdout == ""


def test_every_console_guards_its_text():
    sources = [path for room in ("rig", "sim", "calibration") for path in Path(room).rglob("*.py")]
    assert sources
    assert [path for path in sources if re.search(r"\bConsole\(", path.read_text(encoding="utf-8"))] == []


@pytest.mark.parametrize(
    "arguments",
    ["config show", *(pytest.param(words, marks=pytest.mark.nightly) for words in ("--help", "nix --json"))],
)
def test_full_output_device_is_an_error_with_a_next_step(arguments, tmp_path):
    with Path("/dev/full").open("w") as full:
        done = subprocess.run([*RIG, *arguments.split()], stdout=full, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert "Error 201 (output)" in done.stderr
    assert "Next step:" in done.stderr
    assert "Traceback" not in done.stderr
    assert "ignored" not in done.stderr


def test_unexpected_errors_and_broken_plug_ins_are_neutral(tmp_path):
    about = tmp_path / "plugin-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: plugin\nVersion: 1\n")
    commands = "broken = broken_plugin:go\nraising = raising_plugin:go\nremoved = removed.plugin:go\n"
    (about / "entry_points.txt").write_text(f"[rig.commands]\n{commands}")
    (tmp_path / "broken_plugin.py").write_text("raise RuntimeError('\\x1b[2Jbroken')")
    (tmp_path / "raising_plugin.py").write_text(
        "from rig.cli.ui.command import command\nfrom rig.cli.ui.settings import Settings\n\n\n"
        "@command\ndef go(settings: Settings) -> None:\n    raise ZeroDivisionError('\\x1b]0;raised\\x07')\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    done = subprocess.run([*RIG, "broken"], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert is_safe(done.stdout + done.stderr)
    assert "The plug-in broken_plugin:go cannot be loaded" in done.stderr
    assert done.stderr.endswith("\\u001b[2Jbroken\n")
    done = subprocess.run([*RIG, "--help"], env=environment, capture_output=True, text=True, check=True)
    assert re.search(r"^  removed +Cannot be loaded: No module named 'removed'\.$", done.stdout, re.MULTILINE)
    done = subprocess.run([*RIG, "raising"], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert is_safe(done.stdout + done.stderr)
    assert "ZeroDivisionError: \\u001b]0;raised\\u0007" in done.stderr
    assert "Error 100 (internal error).\nNext step: " in done.stderr


def test_closed_output_is_no_error(tmp_path):
    done = subprocess.run(
        ["sh", "-c", '"$@" >&-', "sh", *RIG, "config", "show"], stderr=subprocess.PIPE, text=True, cwd=tmp_path
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_progress_of_a_scan_is_replaced_and_cannot_control_the_terminal(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    with guarded_output():
        show_progress("/dev/ttyUSB0\x1b[2J: scanning")
    assert terminal.getvalue() == "\r\x1b[K/dev/ttyUSB0\\u001b[2J: scanning\r"
