"""The commands, outputs and files that the README and the first guides show are those of the program."""

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rig.cli.main import app
from rig.cli.ui.exit_codes import EXIT_CODES
from tests import DIGITS_ARE_THOSE_STORED
from tests.programs import Program

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
GUIDES = {
    name: (ROOT / "docs" / "how-to" / f"{name}.md").read_text(encoding="utf-8")
    for name in ("install", "enroll-and-identify", "troubleshoot", "call-the-rig", "first-light")
}
COMMANDS = (
    "enroll mug-white --bench sim --views 12",
    "enroll mug-star --bench sim --views 12",
    "identify --bench sim --set bench.sim.object=mug-white --seed 14",
)
LEFT_OUT = re.compile(r"(Picture|Image) of the empty|Empty-table image|  Unwinding|  table at |Note|.*views, about")


def blocks(language: str, page: str = README) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page, re.DOTALL)


def own_folders(folder: Path, patch: pytest.MonkeyPatch) -> None:
    for kind in ("CONFIG", "DATA", "STATE", "CACHE"):
        patch.setenv(f"XDG_{kind}_HOME", str(folder))


def walk_through() -> str:
    """Run the commands of the walk-through and return what the README shows: "..." stands for lines left out."""
    lines = []
    for command in COMMANDS:
        lines.append(f"$ rig {command}")
        done = CliRunner().invoke(app, command.split(), env={"COLUMNS": "200"})
        assert done.exit_code == 0, done.output
        for line in done.stdout.splitlines():
            if not (LEFT_OUT.match(line) or (command.startswith("enroll") and line.startswith("view "))):
                lines.append(line)
            elif lines[-1] != "...":
                lines.append("...")
        if lines[-1] == "...":
            del lines[-1]
    return "\n".join(lines) + "\n"


@pytest.mark.skipif(not DIGITS_ARE_THOSE_STORED, reason="this processor rounds other digits than those shown")
def test_walk_through_shows_the_real_output(tmp_path, monkeypatch):
    own_folders(tmp_path, monkeypatch)
    assert blocks("console") == [walk_through()], "write it again: python -m tests.test_readme"


def test_library_example_finds_the_object(tmp_path):
    (code,) = blocks("python")
    program = Program(code=code, folder=tmp_path)
    output, errors = program.communicate()
    assert program.returncode == 0, errors
    assert output.splitlines()[-1].startswith("teapot ")


def test_every_command_and_option_exists():
    pages = "\n".join([README, *GUIDES.values()])
    shown = re.findall(r"^ {4}rig ([^#\n]+)|`rig ([^`\n]+)`|^\$ rig ([^\n]+)", pages, re.MULTILINE)
    assert len(shown) >= 20
    helps: dict[tuple[str, ...], str] = {}
    for found in shown:
        words = next(filter(None, found)).split()
        groups = ("catalog", "results", "calibrate", "config", "servo")
        name = tuple(words[: 2 if words[0] in groups and len(words) > 1 and not words[1].startswith("-") else 1])
        if name not in helps:
            done = CliRunner().invoke(app, [*name, "--help"], env={"COLUMNS": "200"})
            assert done.exit_code == 0, words
            helps[name] = done.output
        for option in re.findall(r"--[a-z-]+", " ".join(words)):
            assert option in helps[name], words


def test_tables_list_the_common_options_and_the_exit_codes():
    options = re.findall(r"^\| `(--[a-z-]+)", GUIDES["call-the-rig"], re.MULTILINE)
    assert sorted(options) == sorted(["--bench", "--config", "--set", "--seed", "--json", "--no-color"])
    codes = re.findall(r"^\| ([\d, ]+) \|", GUIDES["call-the-rig"], re.MULTILINE)
    assert set(EXIT_CODES) <= {int(code) for cell in codes for code in cell.split(",")}


def test_every_linked_file_exists():
    for link in re.findall(r"\]\((?!http)([^)#]+)", README):
        assert (ROOT / link).exists(), link


def test_toml_example_is_a_valid_configuration(tmp_path):
    from rig.config import load_config

    (toml,) = blocks("toml", GUIDES["first-light"])
    (tmp_path / "rig.toml").write_text(toml, encoding="utf-8")
    assert load_config(tmp_path / "rig.toml").servo.port == "/dev/ttyUSB0"


def test_sample_tray_can_be_read(tmp_path):
    from rig.plans.tray import read_tray

    (tray,) = blocks("csv", GUIDES["enroll-and-identify"])
    (tmp_path / "tray.csv").write_text(tray, encoding="utf-8")
    assert [item.name for item in read_tray(tmp_path / "tray.csv")] == ["lamp", "toy-car", "dice"]


def test_folders_of_the_data_are_those_of_the_configuration(monkeypatch):
    import platformdirs

    from rig.config import RigConfig

    monkeypatch.setattr(platformdirs, "user_data_dir", lambda app: f"~/.local/share/{app}")
    monkeypatch.setattr(platformdirs, "user_state_dir", lambda app: f"~/.local/state/{app}")
    config = RigConfig()
    for path in (config.catalog_path("BENCH"), config.calibration_path("BENCH"), config.state_path("BENCH")):
        assert f"`{path}/`" in GUIDES["install"]


if __name__ == "__main__":
    import tempfile

    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        own_folders(Path(folder), patch)
        new = walk_through()
    (old,) = blocks("console")
    (ROOT / "README.md").write_text(README.replace(f"```console\n{old}```", f"```console\n{new}```"), encoding="utf-8")
    print(new)
