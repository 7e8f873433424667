"""The state of a bench on the disk, and the program that holds the bench."""

import json
import os
import signal
import subprocess
import sys
from contextlib import closing, suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.bench import open_bench
from rig.config import load_config
from rig.core.clock import SystemClock
from rig.core.errors import BenchBusy, Stalled, StateNotStored
from rig.core.next_steps import Do
from rig.safety.saved_state import (
    LATCH_BYTES,
    SERVER_FILE,
    SERVER_FOLDER,
    SESSION,
    BenchLock,
    BenchState,
    FileStore,
    Holder,
    LatchedFault,
    SavedTable,
    ServerAddress,
    busy,
    holder,
)
from sim.faults.environment import fill_disk
from tests.fuzzing import fuzz_settings

HOLD = """
import sys, time
from pathlib import Path
from rig.core.clock import SystemClock
from rig.safety.saved_state import BenchLock
lock = BenchLock(Path(sys.argv[1]), SystemClock())
print("held", flush=True)
time.sleep(60)
"""

TABLE = SavedTable(
    model_number=1060,
    bus_id=1,
    firmware=46,
    position_deg=-190.25,
    shift_deg=360.0,
    zero_deg=12.5,
    direction=-1,
    gear_ratio=1.0,
)


@pytest.fixture
def other_program(tmp_path):
    """Return a process that holds the bench."""
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path), "teapot"], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


@given(
    table=st.none()
    | st.builds(
        SavedTable,
        position_deg=st.floats(-1e5, 1e5),
        shift_deg=st.floats(-1e5, 1e5),
        path_deg=st.none() | st.tuples(st.floats(-1e5, 1e5), st.floats(-1e5, 1e5)),
        model_number=st.integers(0, 65535),
        bus_id=st.integers(0, 252),
        firmware=st.integers(0, 255),
        zero_deg=st.floats(-360, 360),
        direction=st.sampled_from([-1, 1]),
        gear_ratio=st.floats(0.1, 10),
    ),
    what=st.text(),
)
def test_state_round_trips(tmp_path_factory, table, what):
    fault = LatchedFault.of(Stalled(what, next_step="Free it.", evidence={"load_percent": 99.0}), "2026-01-02T03:04:05")
    state = BenchState(table=table, fault=fault)
    folder = tmp_path_factory.getbasetemp() / "state"
    FileStore(folder).save(state)
    assert FileStore(folder).load() == state
    assert not list(folder.glob("*.part"))


@pytest.mark.parametrize("fault", [False, True])
def test_each_flipped_byte_of_the_state_is_damage(tmp_path, fault):
    stored = BenchState(table=TABLE.model_copy(update={"path_deg": (0.0, 90.5)}), fault=STALLED if fault else None)
    FileStore(tmp_path).save(stored)
    content = (tmp_path / "state.json").read_bytes()
    for place in range(len(content)):
        for bit in (0, place % 8):
            flipped = bytearray(content)
            flipped[place] ^= 1 << bit
            (tmp_path / "state.json").write_bytes(flipped)
            state = FileStore(tmp_path).load()
            if not state.damage:  # another white space between the values
                assert state == stored
                assert flipped.split() == content.split()
            else:
                assert state.fault is not None
                assert state.table is None


@fuzz_settings(0.1)
@given(st.binary(max_size=300))
def test_damaged_state_is_reported_and_not_used(tmp_path_factory, damage):
    folder = tmp_path_factory.getbasetemp() / "damaged"
    folder.mkdir(exist_ok=True)
    (folder / "state.json").write_bytes(damage)
    state = FileStore(folder).load()
    assert state.table is None
    assert state.fault.code == StateNotStored.code  # a fault may be lost with the state
    assert state.damage
    FileStore(folder).save(state)
    assert not FileStore(folder).load().damage
    assert FileStore(folder).load().fault == state.fault
    FileStore(folder).latch(None)


@pytest.mark.parametrize(
    "text",
    [
        '{"version": 1}',
        '{"version": 2}',
        '{"version": 1, "table": {"position_deg": 3}}',
        '{"version": 1, "colour": "red"}',
    ],
)
def test_unknown_version_or_shape_is_not_used(tmp_path, text):
    (tmp_path / "state.json").write_text(text)
    assert FileStore(tmp_path).load().damage


def test_unwritable_folder_is_reported_with_a_next_step(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StateNotStored, match="may not move without it") as caught:
        FileStore(tmp_path / "file" / "bench").save(BenchState(table=TABLE))
    assert "state_dir" in caught.value.next_step
    with pytest.raises(StateNotStored):
        BenchLock(tmp_path / "file" / "bench", SystemClock())


def test_interrupted_write_keeps_the_old_state(tmp_path, monkeypatch):
    store = FileStore(tmp_path)
    store.save(BenchState(table=TABLE))

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StateNotStored) as caught:
        store.save(BenchState())
    assert caught.value.evidence["reason"] == "No space left on device"
    assert store.load().table == TABLE


STALLED = LatchedFault.of(Stalled("Blocked.", next_step="Free it.", evidence={"load_percent": 99.0}), "2026-01-02")


def test_full_disk_does_not_lose_a_fault(tmp_path):
    store = FileStore(tmp_path)
    store.save(BenchState(table=TABLE))
    free = fill_disk()
    try:
        with pytest.raises(StateNotStored):
            store.save(BenchState())
        store.latch(STALLED)
    finally:
        free()
    assert FileStore(tmp_path).load() == BenchState(table=TABLE, fault=STALLED)
    store.latch(None)
    assert FileStore(tmp_path).load() == BenchState(table=TABLE)


def test_fault_larger_than_its_file_is_stored_without_evidence(tmp_path):
    store = FileStore(tmp_path)
    store.save(BenchState(table=TABLE))
    store.latch(LatchedFault.of(Stalled("x" * 9000, next_step="y", evidence={"z": "z" * 9000}), "2026-01-02"))
    assert store.load().fault.detail == "x" * 500
    assert (tmp_path / "latch").stat().st_size == LATCH_BYTES


@pytest.mark.parametrize("name", ["state.json", "latch"])
@pytest.mark.parametrize("spoil", ["delete", "truncate", "half", "flip", "unreadable"])
@pytest.mark.parametrize("fault", [None, STALLED], ids=["no fault", "fault"])
def test_damaged_state_counts_as_latched(tmp_path, name, spoil, fault):
    store = FileStore(tmp_path)
    store.save(BenchState(table=TABLE, fault=fault))
    path = tmp_path / name
    content = path.read_bytes()
    if spoil in ("delete", "unreadable"):
        path.unlink()
    if spoil == "unreadable":
        path.mkdir()
    elif spoil != "delete":
        path.write_bytes({"truncate": b"", "half": content[: len(content) // 2], "flip": b"}" + content[1:]}[spoil])
    state = FileStore(tmp_path).load()
    assert state.damage
    assert state.fault == fault or state.fault.code in (StateNotStored.code, Stalled.code)
    assert state.fault is not None


@pytest.mark.parametrize("whole_folder", [False, True])
def test_deleted_state_is_not_a_new_bench(tmp_path, whole_folder):
    assert FileStore(tmp_path / "bench").load() == BenchState()
    FileStore(tmp_path / "bench").save(BenchState(table=TABLE, fault=STALLED))
    for file in (tmp_path / "bench").iterdir():
        file.unlink()
    if whole_folder:
        (tmp_path / "bench").rmdir()
    state = FileStore(tmp_path / "bench").load()
    assert state.table is None  # the angle is in doubt
    assert state.fault.code == StateNotStored.code
    FileStore(tmp_path / "bench").save(state.model_copy(update={"damage": ""}))
    assert FileStore(tmp_path / "bench").load().fault == state.fault


def test_second_program_reports_the_one_that_uses_the_bench(tmp_path, other_program):
    who = holder(tmp_path)
    assert who.pid == other_program.pid
    assert "teapot" in who.command
    assert not who.terminates  # it has no handler: SIGTERM would leave the torque on
    with pytest.raises(BenchBusy, match=rf"process {other_program.pid} .*teapot") as caught:
        BenchLock(tmp_path, SystemClock())
    assert caught.value.exit_code == 9
    assert Do.STOP() in caught.value.steps


@pytest.mark.parametrize("served", [True, False])
def test_bench_of_a_server_is_reported_with_its_page(tmp_path, other_program, served):
    with closing(BenchLock(tmp_path / SERVER_FOLDER, SystemClock())):
        address = ServerAddress(pid=os.getpid(), url="http://localhost:8000", token="t")
        (tmp_path / SERVER_FOLDER / SERVER_FILE).write_text(address.model_dump_json())
        error = busy(tmp_path, holder(tmp_path / SERVER_FOLDER if served else tmp_path))
    assert ("http://localhost:8000" in error.next_step) == served
    assert f"process {os.getpid() if served else other_program.pid} " in str(error)


def test_killed_program_releases_the_bench(tmp_path, other_program):
    other_program.send_signal(signal.SIGKILL)
    other_program.wait()
    assert str(other_program.pid) in (tmp_path / "lock").read_text()
    assert holder(tmp_path) is None
    assert holder(tmp_path / "never") is None
    BenchLock(tmp_path, SystemClock()).close()
    assert holder(tmp_path) is None


def test_holder_without_readable_name_still_counts(tmp_path, other_program):
    (tmp_path / "lock").write_text("{")
    assert holder(tmp_path) == Holder(pid=0, command="", since_utc="")
    with pytest.raises(BenchBusy, match="another process"):
        BenchLock(tmp_path, SystemClock())


@pytest.mark.parametrize("name", ["lock", "latch", "stop", "state.json", "state.json.part"])
def test_no_file_is_written_through_a_link(tmp_path, name):
    victim, bench = tmp_path / "victim", tmp_path / "bench"
    victim.write_bytes(b"x" * LATCH_BYTES)
    bench.mkdir()
    (bench / name).symlink_to(victim)
    with suppress(StateNotStored):
        BenchLock(bench, SystemClock()).close()
    for write in (
        lambda store: store.save(BenchState(table=TABLE)),
        lambda store: store.latch(STALLED),
        FileStore.request_stop,
        FileStore.listen,
    ):
        with suppress(StateNotStored):
            write(FileStore(bench))
    assert victim.read_bytes() == b"x" * LATCH_BYTES
    (bench / name).unlink(missing_ok=True)
    (bench / name).symlink_to(tmp_path / "nowhere")
    with suppress(StateNotStored):
        FileStore(bench).listen()
    with suppress(StateNotStored):
        BenchLock(bench, SystemClock()).close()
    assert not (tmp_path / "nowhere").exists()


def test_each_bench_has_its_own_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "states"))
    assert load_config().state_path("hardware") == tmp_path / "states" / "hbr-rig" / "hardware"
    (tmp_path / "rig.toml").write_text('state_dir = "here"\n')
    assert load_config().state_path("sim") == tmp_path / "here" / "sim"
    assert json.loads(load_config().model_dump_json())["state_dir"] == str(tmp_path / "here")


@pytest.mark.parametrize(("error", "ended"), [(ValueError, "failed"), (KeyboardInterrupt, "interrupted")])
def test_error_of_the_one_who_shows_a_job_is_how_its_session_ended(tmp_path, error, ended):
    config = load_config(None, [f"state_dir={tmp_path}"])

    def job():
        with open_bench("sim", config):
            yield "a step"

    with pytest.raises(error), closing(job()) as steps:
        for step in steps:
            raise error(step)
    assert json.loads((config.state_path("sim") / SESSION).read_text())["ended"] == ended
