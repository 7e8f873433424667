"""A release: one version everywhere, workflows whose actions cannot change, and a program that `uvx hbr-rig` finds."""

import re
import tomllib
from importlib.metadata import version

import pytest
import yaml

from tests.docs.pages import DOCS

ROOT = DOCS.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def test_citation_and_changelog_name_the_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert version("hbr-rig") == PROJECT["version"] == citation["version"] == newest[1]
    assert citation["license"] == PROJECT["license"]


def test_the_project_is_also_the_name_of_the_program():
    assert PROJECT["scripts"][PROJECT["name"]] == PROJECT["scripts"]["rig"]


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_pin_actions_and_grant_write_access_to_single_jobs_only(path):
    text = path.read_text()
    used = re.findall(r"uses: (.*)", text)
    assert used
    assert all(re.fullmatch(r"[\w./-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+", action) for action in used)
    assert yaml.safe_load(text)["permissions"] == {"contents": "read"}


def test_one_action_has_one_commit_in_all_workflows():
    pins = {tuple(action.split("@")) for path in WORKFLOWS for action in re.findall(r"uses: (.*)", path.read_text())}
    by_repository = {"/".join(action.split("/")[:2]): pin for action, pin in pins}
    assert {pin for _, pin in pins} == set(by_repository.values())


def test_only_a_pushed_tag_publishes_and_only_with_attestations():
    release = yaml.safe_load(next(path for path in WORKFLOWS if path.stem == "release").read_text())
    assert release[True] == {"push": {"tags": ["v[0-9]*"]}}  # YAML reads `on` as a truth value
    publish = release["jobs"]["publish"]
    (upload,) = (step for step in publish["steps"] if step.get("uses", "").startswith("pypa/gh-action-pypi-publish@"))
    assert upload["with"] == {"attestations": True}
    assert (publish["needs"], publish["environment"]) == ("build", "pypi")
    assert publish["permissions"]["id-token"] == "write"
    assert "id-token" not in str(release["jobs"]["build"])
