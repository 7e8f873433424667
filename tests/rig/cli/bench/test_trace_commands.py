"""`rig servo record` and `rig servo replay`: a trace of the simulated bench is that of the simulated bench."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

import sim.servo.models
from rig.cli.main import app
from tests.small import SMALL_WORDS

Rig = Callable[..., Result]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A trace of the simulated bench, whose IMU has a number that could be secret."""
    file = tmp_path_factory.mktemp("trace") / "bench.jsonl"
    port = ("--set", "servo.port=/dev/serial/by-id/usb-FTDI_FT4NZSECRET")
    done = CliRunner().invoke(app, ["servo", "record", str(file), "--bench", "sim", "--yes", *port, *SMALL_WORDS])
    assert done.exit_code == 0, done.output
    assert f"Recorded {file}" in done.output
    return file.read_bytes()


@pytest.fixture
def trace(rig: Rig, recorded: bytes) -> Rig:
    Path("bench.jsonl").write_bytes(recorded)
    return rig


def differing(done: Result) -> list[str]:
    assert done.exit_code == 6, done.output
    evidence = json.loads(done.stdout)["evidence"]
    return [f"{kind}: {one}" for kind in ("driver", "simulator") for one in evidence[kind]["differences"]]


def test_a_trace_of_the_simulated_bench_has_no_difference(trace: Rig, recorded: bytes):
    done = trace("servo", "replay", "bench.jsonl", "--json")
    assert done.exit_code == 0, done.output
    values = json.loads(done.stdout)
    assert values["driver"]["compared"] > 300
    assert values["simulator"]["compared"] > 1000
    times = values["simulator"]["reply_ms"]
    assert times["now"]["median"] == pytest.approx(times["recorded"]["median"], rel=0.01)
    assert b"SECRET" not in recorded
    lines = [json.loads(line) for line in recorded.splitlines()]
    assert lines[0]["trace"] == 1
    devices = {line["on"]: line["notes"] for line in lines[1:] if "notes" in line}
    assert devices.keys() == {"servo", "imu", "camera"}
    assert devices["imu"]["samples"] > 100


def test_a_register_that_differs_is_named(trace: Rig, monkeypatch: pytest.MonkeyPatch):
    models = sim.servo.models.MODELS
    other = replace(models["xl430_w250"], initial={**models["xl430_w250"].initial, "Position P Gain": 650})
    monkeypatch.setattr(sim.servo.models, "MODELS", {**models, "xl430_w250": other})
    (found,) = differing(trace("servo", "replay", "bench.jsonl", "--json"))
    assert re.fullmatch(
        r"simulator: servo Position P Gain at \d\.\d+ s: recorded 640, now 650 \((\d+) of \1 differ\)", found
    )
    shown = trace("servo", "replay", "bench.jsonl")
    assert shown.exit_code == 6
    assert "recorded 640, now 650" in shown.output


@pytest.mark.parametrize(
    ("before", "after", "differences"),
    [
        (b'"data":"24042e"', b'"data":"24042f"', ["driver: servo reply at 0.000 s: recorded "]),
        (
            b'"read":"68","address":117',
            b'"read":"70","address":117',
            ["driver: imu ", "simulator: imu register 0x75 at", "recorded 112, now 104"],
        ),
    ],
)
def test_a_device_that_sent_other_values_is_noticed(
    trace: Rig, recorded: bytes, before: bytes, after: bytes, differences: list[str]
):
    assert before in recorded
    Path("other.jsonl").write_bytes(recorded.replace(before, after))
    found = " ".join(differing(trace("servo", "replay", "other.jsonl", "--json")))
    assert [one for one in differences if one not in found] == []


def test_a_recording_that_was_killed_is_readable(trace: Rig, recorded: bytes):
    for length in (9000, 9400, recorded.index(b'"reply"', 9000) + 20):
        Path("cut.jsonl").write_bytes(recorded[:length])
        done = trace("servo", "replay", "cut.jsonl")
        assert done.exit_code == 0, done.output
        assert "Its last line is cut off" in done.output


def test_damage_is_an_error_with_a_next_step(trace: Rig, recorded: bytes):
    lines = recorded.splitlines(keepends=True)
    damaged = b"".join([*lines[:7], lines[7].replace(b'"t_ns":', b'"t_ns":-'), *lines[8:]])
    for content, number in ((b"", 1), (b"garbage\n", 1), (b'{"trace":2}\n', 1), (b"\xff\n", 1), (damaged, 8)):
        Path("damaged.jsonl").write_bytes(content)
        done = trace("servo", "replay", "damaged.jsonl")
        assert done.exit_code == 2
        assert f"damaged.jsonl is no trace that this program can read: its line {number} is wrong." in done.output
        assert "Next step: Restore the file" in done.output
    assert trace("servo", "replay", "missing.jsonl").exit_code == 2
    Path("model.jsonl").write_bytes(recorded.replace(b'"model":"xl430_w250"', b'"model":"none"', 1))
    assert trace("servo", "replay", "model.jsonl").exit_code == 3


def test_record_asks_before_it_moves_and_overwrites_nothing(rig: Rig):
    assert rig("servo", "record", "trace.jsonl").exit_code == 2  # there is no terminal to ask on
    assert not Path("trace.jsonl").exists()
    assert rig("servo", "record", "trace.jsonl", "--still").exit_code == 0
    content = Path("trace.jsonl").read_bytes()
    done = rig("servo", "record", "trace.jsonl", "--still")
    assert done.exit_code == 2
    assert "Give a new file" in done.output
    assert Path("trace.jsonl").read_bytes() == content


def test_any_command_can_be_recorded(rig: Rig):
    assert rig("goto", "20", "--set", "trace='goto.jsonl'").exit_code == 0
    assert rig("servo", "replay", "goto.jsonl").exit_code == 0


def test_a_missing_imu_does_not_end_the_recording(rig: Rig):
    done = rig("servo", "record", "servo.jsonl", "--yes", "--set", 'bench.sim.faults=["imu.off", "camera.off"]')
    assert done.exit_code == 0, done.output
    assert "The trace has no imu." in done.output
    assert "The trace has no camera." in done.output
    assert rig("servo", "replay", "servo.jsonl").exit_code == 0


def test_corrupt_frame_of_a_rig_head_is_noticed(rig: Rig):
    assert rig("servo", "record", "head.jsonl", "--still", "--set", "imu.connection=head").exit_code == 0
    assert rig("servo", "replay", "head.jsonl").exit_code == 0
    lines = [json.loads(line) for line in Path("head.jsonl").read_text().splitlines()]
    longest = max((line for line in lines if line.get("on") == "head"), key=lambda line: len(line.get("read") or ""))
    longest["read"] = longest["read"][:20] + "01" * 4 + longest["read"][28:]
    Path("head.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    (found,) = differing(rig("servo", "replay", "head.jsonl", "--json"))
    assert found.startswith("driver: head corrupt frames at ")
