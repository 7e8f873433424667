"""The documentation site: complete generated pages, a navigation that reaches every page, links that exist."""

import importlib
import re
import shlex
import tomllib
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from docs import architecture, generate
from rig.config import RigConfig
from rig.config.wording import key_info
from rig.core.errors import ExtraMissing
from tests.docs.pages import DOCS

ROOT = DOCS.parent


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    return generate.generated_pages()


def test_command_page_has_every_command_and_option(pages):
    text = pages["reference/cli.md"]
    for command in ("rig enroll", "rig catalog show", "rig calibrate servo", "rig faults", "rig config set"):
        assert f"\n## {command}\n" in text
    for option in ("--bench", "--resume", "--save-run", "--print-board", "--udev"):
        assert f"`{option}`" in text


def test_configuration_page_has_every_key(pages):
    sections = re.split(r"\n## ", pages["reference/configuration.md"])
    for info in key_info(RigConfig):
        above = f"[{info.key[0]}]" if len(info.key) > 1 else "Top level"
        (text,) = (s for s in sections if s.startswith(above))
        assert f"| `{info.key[-1]}` |" in text or info.name == "bench", info.name


def test_error_page_has_each_code_once(pages):
    codes = re.findall(r'^\| <a id="(\d{3})"></a>\1 \|', pages["reference/errors.md"], re.MULTILINE)
    assert len(codes) == len(set(codes)) > 40
    assert codes == sorted(codes)


def test_api_pages_have_every_module(pages):
    shown = set(re.findall(r"^::: (\S+)$", "\n".join(pages.values()), re.MULTILINE))
    assert {"hbr.dense.filter", "rig.core.errors", "sim.world", "calibration.backlash"} <= shown
    assert all(module in generate.modules() for module in shown)


def entries(nav: list[Any]) -> list[str]:
    """Return the pages of the navigation."""
    found = []
    for entry in nav:
        values = entry.values() if isinstance(entry, dict) else [entry]
        for value in values:
            found += entries(value) if isinstance(value, list) else [value]
    return found


def test_navigation_reaches_every_page_once(pages):
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    reached = entries(generate._expanded(yaml.safe_load(text)["nav"]))
    stored = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}
    assert sorted(reached) == sorted(stored | pages.keys())


def test_links_between_pages_exist():
    for path in [*DOCS.rglob("*.md"), *(ROOT / page for page in generate.REPOSITORY_PAGES)]:
        for target in re.findall(r"\]\((?!https?:|#)([^)#\s]+)", path.read_text(encoding="utf-8")):
            generated = target.startswith("../images/architecture")
            assert generated or (path.parent / target).exists(), f"{path.relative_to(ROOT)}: {target}"


def test_page_of_events_has_its_tables_on_the_site():
    page = SimpleNamespace(file=SimpleNamespace(generated_by=None, src_uri="reference/events.md"))
    text = generate.on_page_markdown((DOCS / "reference/events.md").read_text(encoding="utf-8"), page)
    for heading in ("## started", "## frame_used", "### view_evidence", "### stop_decision", "## Codes"):
        assert text.count(f"\n{heading}\n") == 1
    assert "| `rotation_imu_deg` | number or null | The same rotation by the gyro; null" in text


def test_links_out_of_docs_are_rewritten_for_the_site():
    text, copied = generate.with_site_links(
        "[a](../README.md#use) [b](../examples/tray.csv) [c](../tests)", "docs/results.md"
    )
    assert text == "[a](index.md#use) [b](files/examples/tray.csv) c"
    assert copied == {"examples/tray.csv"}


def test_decisions_have_numbers_without_gaps_and_are_listed():
    paths = sorted(DOCS.glob("decisions/0*.md"))
    index = (DOCS / "decisions" / "README.md").read_text(encoding="utf-8")
    numbers = [int(path.name[:4]) for path in paths]
    assert numbers == list(range(1, len(numbers) + 1))
    for number, path in zip(numbers, paths, strict=True):
        text = path.read_text(encoding="utf-8")
        assert text.startswith(f"# {number:04} ")
        assert f"({path.name})" in index
        assert re.findall(r"^## (.*)$", text, re.MULTILINE) == ["Decision", "Reasons", "Consequences"]


def test_every_decision_is_named_where_it_applies():
    sources = [ROOT / "Makefile", *(path for package in generate.PACKAGES for path in (ROOT / package).rglob("*.py"))]
    named = {n for path in sources for n in re.findall(r"docs/decisions/(\d{4})", path.read_text(encoding="utf-8"))}
    assert named == {path.name[:4] for path in DOCS.glob("decisions/0*.md")}


def test_architecture_picture_shows_every_room():
    svg = architecture.picture()
    for package in ("rig", "hbr"):
        for room in (room for layer in architecture.layers(package) for room in layer):
            assert f">{room.partition('.')[2]}</text>" in svg
    assert ("rig.plans", "rig.search") in architecture.imports()
    assert not any(
        importing.startswith("hbr") and imported.startswith("rig") for importing, imported in architecture.imports()
    )


def test_commands_of_the_attacks_select_tests():
    commands = re.findall(r"`(tests/[^`]+)`", (DOCS / "explanation/security.md").read_text(encoding="utf-8"))
    assert len(commands) > 30
    for command in commands:
        words = shlex.split(command)
        places = [ROOT / word for word in words if word.startswith("tests/")]
        files = [file for place in places for file in ([place] if place.is_file() else place.rglob("test_*.py"))]
        text = "\n".join(file.name + file.read_text(encoding="utf-8") for file in files)
        expression = words[words.index("-k") + 1] if "-k" in words else ""
        for name in set(re.findall(r"\w+", expression)) - {"or"}:
            assert re.search(rf"(def test|class Test|test_)\w*{name}", text), (command, name)


def test_tests_of_the_stops_exist():
    """Each way to stop names the tests that prove it."""
    found = re.findall(r"`(tests/\S+?)::(\w+)`", (DOCS / "explanation/stops.md").read_text(encoding="utf-8"))
    assert len(found) > 10
    for file, name in found:
        assert f"def {name}(" in (ROOT / file).read_text(encoding="utf-8"), (file, name)


@pytest.mark.parametrize("file", ["docs/deploy/Dockerfile", ".ci/setup", ".ci/install"])
def test_every_download_has_a_hash(file):
    """A build without isolation downloads no build backend."""
    text = (ROOT / file).read_text(encoding="utf-8").replace("\\\n", " ")
    commands = re.findall(r"\bpip\S* (?:install|sync|wheel|download)\b[^;&\n]*|-m build\b[^;&\n]*", text)
    assert commands
    for command in commands:
        builds = any(part in command for part in ("-m build", "requirements.lock", '"$lock"', "--no-deps"))
        assert "--no-isolation" in command or "--no-build-isolation" in command or not builds, command
        downloads = "-m build" not in command and "--no-deps" not in command
        assert "--require-hashes" in command or "--no-index" in command or not downloads, command


def test_names_of_the_code_in_the_pages_exist():
    """Each `hbr.…`, `rig.…`, `sim.…` or `calibration.…` in backticks is a module, or is defined in one."""
    groups = set(tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"])
    others = {"rig.toml", "rig.py", "rig.local", "rig.imus", "rig.servos"} | groups
    pattern = r"`((?:hbr|rig|sim|calibration)(?:\.[A-Za-z_]\w*)+)"
    found = {
        (path.name, name)
        for path in [*DOCS.rglob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md"]
        for name in re.findall(pattern, path.read_text(encoding="utf-8"))
        if name not in others
    }
    assert not [one for one in sorted(found) if not _exists(one[1].split("."))]


def _exists(parts):
    for count in range(len(parts), 0, -1):
        try:
            value = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        except ExtraMissing:  # the module is there; the packages that it needs are not
            return True
        for name in parts[count:]:
            if name in getattr(value, "__dataclass_fields__", {}) or name in getattr(value, "__annotations__", {}):
                return True
            if not hasattr(value, name):
                return False
            value = getattr(value, name)
        return True
    return False
