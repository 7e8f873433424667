"""The file of a trace: what was written is read, anything else is an error, and a full disk does not stop the bench."""

import json
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.config import RigConfig
from rig.core.errors import RigError, UsageError
from rig.core.json_form import plain
from rig.devices.dynamixel.packets import Reply
from rig.devices.trace import TracedSerial, TraceEvent, TraceWriter, read_trace
from rig.doctor.replay import replay_drivers
from sim.clock import VirtualClock
from sim.servo import ServoBus, SimSerial
from tests.fuzzing import examples

BYTE = st.integers(0, 255)
REPLIES = st.builds(Reply, BYTE, BYTE, BYTE, st.binary(max_size=8), BYTE)
EVENTS = st.one_of(
    st.fixed_dictionaries({"write": st.binary(max_size=20)}),
    st.fixed_dictionaries({"read": st.binary(min_size=1, max_size=20)}),
    st.fixed_dictionaries({"reply": REPLIES}),
    st.fixed_dictionaries({"address": BYTE, "read": st.binary(min_size=1, max_size=8)}),
    st.fixed_dictionaries({"notes": st.dictionaries(st.text(max_size=8), st.integers() | st.text(max_size=8))}),
)
DEVICES = st.sampled_from(["servo", "imu", "head", "camera"])


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "trace.jsonl"


def written(file: Path, events: list[tuple[str, dict[str, object]]]) -> bytes:
    file.unlink(missing_ok=True)
    clock = VirtualClock()
    writer = TraceWriter(file, clock, "sim", RigConfig())
    for device, values in events:
        clock.sleep(0.01)
        writer.note(device, **values)  # type: ignore[arg-type]
    writer.close()
    return file.read_bytes()


def test_what_was_written_is_read(file: Path):
    @examples(30)
    @given(st.lists(st.tuples(DEVICES, EVENTS), max_size=5), st.integers(0, 40))
    def same(events: list[tuple[str, dict[str, object]]], cut: int) -> None:
        content = written(file, events)
        trace = read_trace(file)
        expected = [
            TraceEvent(t_ns=(number + 1) * 10_000_000, on=device, **values)  # type: ignore[arg-type]
            for number, (device, values) in enumerate(events)
        ]
        assert list(trace.events) == expected
        assert (trace.config, trace.is_cut) == (RigConfig(), False)
        if 0 < cut < len(content.splitlines()[-1]) and events:
            file.write_bytes(content[:-cut])
            again = read_trace(file)
            assert (list(again.events), again.is_cut) == (expected[:-1], True)

    same()


def test_any_content_is_a_trace_or_an_error(file: Path):
    valid = written(file, [("servo", {"write": b"\xff\xff\xfd\x00\x01\x03\x00\x01\x19\x4e"}), ("imu", {"notes": {}})])

    @examples(60)
    @given(st.binary(max_size=60), st.integers(0, len(valid)), st.integers(0, 60))
    def readable(inserted: bytes, at: int, removed: int) -> None:
        for content in (inserted, valid[:at] + inserted + valid[at + removed :]):
            file.write_bytes(content)
            try:
                read_trace(file)
            except RigError as failure:
                error = failure
                json.dumps(plain(error.problem), allow_nan=False)
            else:
                continue
            assert error.next_step

    readable()


def test_any_trace_can_be_replayed(file: Path):
    @examples(30)
    @given(st.lists(st.tuples(DEVICES, EVENTS), max_size=8))
    def replays(events: list[tuple[str, dict[str, object]]]) -> None:
        written(file, events)
        with suppress(RigError):
            json.dumps(replay_drivers(read_trace(file)).as_dict())

    replays()


def test_dropped_bytes_and_a_new_baud_rate_are_in_the_trace(file: Path):
    clock = VirtualClock()
    bus = ServoBus(clock)
    writer = TraceWriter(file, clock, "sim", RigConfig())
    port = TracedSerial(SimSerial(bus, 57_600, 0.005), writer, "servo")
    bus.disturb(b"noise", 57_600)
    clock.sleep(0.1)
    port.reset_input_buffer()
    port.baudrate = 1_000_000
    assert (port.in_waiting, port.baudrate) == (0, 1_000_000)
    port.close()
    writer.close()
    events = [(event.baud, event.read) for event in read_trace(file).events]
    assert events == [(57_600, None), (None, b"noise"), (1_000_000, None)]


def test_a_full_disk_ends_the_trace_but_not_the_work(tmp_path: Path):
    link = tmp_path / "full.jsonl"
    writer = TraceWriter(link, VirtualClock(), "sim", RigConfig())
    with Path("/dev/full").open("wb", buffering=0) as full:
        writer._file.close()
        writer._file = full
        writer.note("servo", baud=57_600)
        writer.note("servo", baud=57_600)
        with pytest.raises(UsageError, match="cannot be written") as failed:
            writer.close()
    assert failed.value.evidence["reason"] == "No space left on device"
