"""The commands on a small catalog, and signals sent to real processes."""

import json
import signal
import sys
from contextlib import closing
from pathlib import Path
from zipfile import ZipFile

import cv2
import numpy as np
import pytest

from rig.catalog import Action, Catalog
from rig.cli.ui.settings import Settings
from rig.core.clock import SystemClock
from rig.safety.saved_state import BenchLock
from tests.programs import Program, stopping_after_view
from tests.small import SMALL_FILE, SMALL_WORDS


@pytest.fixture
def rig(rig, tmp_path):
    (tmp_path / "rig.toml").write_text(SMALL_FILE, encoding="utf-8")
    return rig


def lines(output: str) -> list[dict]:
    return [json.loads(line) for line in output.splitlines()]


def test_missing_catalog_names_the_bench_that_has_one(rig, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    Path("rig.toml").unlink()
    none = rig("catalog", "list")
    assert none.exit_code == 7
    assert "Enroll an object: `rig enroll NAME --bench hardware`" in none.stderr
    assert rig("enroll", "dice", "--views", "4", "--bench", "sim", *SMALL_WORDS).exit_code == 0
    assert "There is no bench 'nobench'." in rig("identify", "--bench", "nobench").stderr
    for arguments in (("catalog", "list"), ("identify",), ("export", "all.zip"), ("log",)):
        done = rig(*arguments)
        assert done.exit_code == 7
        assert "The bench hardware has no catalog yet." in done.stderr
        assert "Add --bench sim to use the catalog of that bench, or" in done.stderr
    shown = json.loads(rig("catalog", "show", "dice", "--bench", "sim", "--json").stdout)
    (enrollment,), times = shown["enrollments"], [view["captured_utc"] for view in shown["views"]]
    assert enrollment["started_utc"] < times[0] < times[-1] < enrollment["finished_utc"]  # all by the bench's clock


@pytest.mark.parametrize("device", ["servo", "imu", "camera"])
def test_status_shows_the_other_devices_if_one_is_missing(rig, device):
    missing = ("--set", f'bench.sim.faults=["{device}.off"]')
    done = rig("status", "--json", *missing)
    result = json.loads(done.stdout)
    broken = [name for name in ("servo", "imu", "camera") if "error" in result[name]]
    assert (broken, done.exit_code) == ([device], 4)
    assert result[device]["error"]["code"] // 100 == 4
    assert f"{device:8s} error 40" in rig("status", *missing).stdout


def test_snapshot_is_written_once(rig):
    assert json.loads(rig("snapshot", "table.png", "--json").stdout)["locks"]["gain"] == 0
    assert cv2.imread("table.png").shape == (240, 320, 3)
    assert "The focus is 120 now" in rig("snapshot", "sharp.png", "--refocus", "--set", "state_dir=state").output
    assert json.loads(Path("state/sim/camera-focus.json").read_text())["focus"] == 120
    for words, code in (
        (("table.png",), 2),
        (("table.jpg",), 2),
        (("nowhere/table.png",), 2),
        (("other.png", "--refocus", "--set", "camera.focus=33"), 2),
        (("other.png", "--set", 'bench.sim.faults=["camera.off"]'), 4),
    ):
        assert rig("snapshot", *words).exit_code == code, words
    assert not Path("other.png").exists()


def test_doctor_writes_a_support_bundle(rig):
    rig("goto", "10")
    assert rig("doctor", "--trace").exit_code == 2
    assert rig("doctor", "--bundle", "a.zip", "--trace").exit_code == 0
    with ZipFile("a.zip") as bundle:
        assert set(bundle.namelist()) >= {"findings.json", "configuration.json", "versions.json", "state.json"}
        findings = json.loads(bundle.read("findings.json"))
        assert {finding["topic"] for finding in findings} >= {"servo", "imu", "camera"}
        assert b'"reply":' in bundle.read("trace.jsonl")
        versions = json.loads(bundle.read("versions.json"))
        assert versions["packages"]["numpy"] == np.__version__
        assert any(text.startswith("log.json: ") for text in versions["missing"])  # there is no catalog yet
    assert rig("doctor", "--bundle", "a.zip").exit_code == 2


SECRET = "w0r,d:@d"
WITH_SECRETS = f"""
default_bench = "sim"
[camera]
source = "rtsp://me:{SECRET}@10.0.0.9/live?token={SECRET}&size=2"
[catalog]
url = "postgresql+psycopg://ada:{SECRET}@host.invalid/rig"
images = "s3://bucket/rig?secret_key={SECRET}"
"""


def test_support_bundle_has_no_passwords_and_tokens(rig):
    other = f'[bench.other]\napi_token = "{SECRET}"\nusers = [{{ name = "ada", password = "{SECRET}" }}]\n'
    Path("rig.toml").write_text(WITH_SECRETS + other)
    rig("--config", "rig.toml", "doctor", "--bundle", "a.zip")
    with ZipFile("a.zip") as bundle:
        texts = {name: bundle.read(name).decode() for name in bundle.namelist()}
    assert {"rig.toml", "findings.json", "configuration.json", "versions.json"} <= texts.keys()
    assert [name for name, text in texts.items() if "w0r" in text] == []
    assert "ada:***@host.invalid/rig" in texts["rig.toml"]
    assert json.loads(texts["configuration.json"])["bench"]["other"]["api_token"] == "***"


@pytest.mark.parametrize(
    "words",
    [
        *("config show", "config show catalog.url --json", "config set camera.source 7", "config check", "log"),
        *("doctor", "doctor --json", "status --json", "catalog list", "catalog list --json", "identify", "enroll mug"),
        "catalog list --set catalog.url=postgresql://ada:w0rd@host.invalid:port/rig",
        "config show catalog --set catalog.url=postgresql://ada:w0rd@host.invalid/rig",
        "config check --set servo.baud=a://b:w0rd@c",
        "config set catalog.url postgresql://ada:w0rd@other.invalid/rig",
        "config set catalog.images s3://ada:w0rd@bucket",
        "config set catalog.password w0rd",
    ],
)
def test_passwords_are_shown_nowhere(rig, words):
    Path("rig.toml").write_text(WITH_SECRETS)
    done = rig(*words.split())
    assert done.output
    assert "w0r" not in done.output, done.output


def test_log_and_users_of_the_bench_hide_passwords(rig, tmp_path, monkeypatch):
    url = "postgresql://ada:w0rd@host.invalid/rig"
    with Catalog.open(tmp_path / "catalog", clock=SystemClock()) as catalog:
        catalog.note(Action.IMPORTED, origin=url, digest="a1")
    texts = [rig("log").output, rig("log", "--json").output]
    monkeypatch.setattr(sys, "argv", ["rig", "jog", "--set", f"catalog.url={url}"])
    with closing(BenchLock(tmp_path / "state" / "hardware", SystemClock())):
        options = ("--bench", "hardware", "--set", "state_dir=state")
        texts += [rig(*words, *options).output for words in (["goto", "20"], ["doctor", "--json"])]
    texts += [str(Settings().merged(overrides=[f"catalog.url={url}"]).arguments())]
    assert all("ada:***@host.invalid" in text for text in (*texts[:3], texts[4]))
    assert not [text for text in texts if "w0rd" in text]


def test_table_rotates_without_a_camera(rig):
    missing = ("--set", 'bench.sim.faults=["camera.off"]')
    assert rig("goto", "20", *missing).exit_code == 0
    assert rig("home", *missing).exit_code == 0
    assert rig("identify", *missing).exit_code != 0


def test_common_options_can_precede_or_follow_the_command(rig):
    before = rig("--seed", "3", "--json", "goto", "30")
    after = rig("goto", "30", "--seed", "3", "--json")
    assert before.exit_code == after.exit_code == 0
    assert before.stdout == after.stdout
    assert rig("goto", "30", "--seed", "4", "--json").stdout != after.stdout


@pytest.mark.parametrize(
    ("number", "code"),
    [
        (signal.SIGTERM, 143),
        *(pytest.param(*one, marks=pytest.mark.nightly) for one in ((signal.SIGINT, 130), (signal.SIGHUP, 129))),
    ],
)
def test_signals_end_an_enrollment_with_their_exit_code_and_resume_continues_it(rig, number, code):
    options = ["--views", "6", "--note", "the owner's", "--yes", "--json"]
    process = Program("enroll", "dice", *options, code=stopping_after_view(3))
    process.wait_until_stopped()
    process.send_signal(number)
    process.send_signal(signal.SIGCONT)
    output, errors = process.communicate(timeout=60)
    stored = sum(json.loads(line).get("event") == "accepted" for line in output.splitlines())
    assert process.returncode == code
    assert 3 <= stored < 6
    assert "`rig enroll dice --resume --json`" in errors
    resumed = rig("enroll", "dice", "--resume", "--json")
    assert resumed.exit_code == 0, resumed.stderr
    events = lines(resumed.stdout)
    assert events[0]["views"] == 6 - stored
    assert events[-1] == {**events[-1], "event": "enrolled", "views": 6}
