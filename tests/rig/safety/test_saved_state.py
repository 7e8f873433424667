"""What a bench remembers on the disk, and who holds it."""

import json
import os
import signal
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.config import load_config
from rig.core.clock import SystemClock
from rig.core.errors import BenchBusy, Stalled, StateNotStored
from rig.safety.saved_state import BenchLock, BenchState, FileStore, Holder, LatchedFault, SavedTable, holder
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

TABLE = SavedTable(model_number=1060, bus_id=1, firmware=46, position_deg=-190.25, shift_deg=360.0)


@pytest.fixture
def somebody(tmp_path):
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
    ),
    what=st.text(),
)
def test_what_was_written_is_read(tmp_path_factory, table, what):
    fault = LatchedFault.of(Stalled(what, next_step="Free it.", evidence={"load_percent": 99.0}), "2026-01-02T03:04:05")
    state = BenchState(table=table, fault=fault)
    folder = tmp_path_factory.getbasetemp() / "state"
    FileStore(folder).save(state)
    assert FileStore(folder).load() == state
    assert not list(folder.glob("*.part"))


@fuzz_settings(0.1)
@given(st.binary(max_size=300))
def test_what_is_damaged_is_told_and_never_believed(tmp_path_factory, damage):
    folder = tmp_path_factory.getbasetemp() / "damaged"
    folder.mkdir(exist_ok=True)
    (folder / "state.json").write_bytes(damage)
    state = FileStore(folder).load()
    assert (state.table, state.fault) == (None, None)
    assert state.damage
    FileStore(folder).save(state)
    assert not FileStore(folder).load().damage


@pytest.mark.parametrize(
    "text", ['{"version": 2}', '{"version": 1, "table": {"position_deg": 3}}', '{"version": 1, "colour": "red"}']
)
def test_another_version_or_shape_is_not_guessed_at(tmp_path, text):
    (tmp_path / "state.json").write_text(text)
    assert FileStore(tmp_path).load().damage


def test_a_folder_that_cannot_be_written_to_is_told_with_what_to_do(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StateNotStored, match="may not move without it") as caught:
        FileStore(tmp_path / "file" / "bench").save(BenchState(table=TABLE))
    assert "state_dir" in caught.value.next_step
    with pytest.raises(StateNotStored):
        BenchLock(tmp_path / "file" / "bench", SystemClock())


def test_a_half_written_state_leaves_the_old_one(tmp_path, monkeypatch):
    store = FileStore(tmp_path)
    store.save(BenchState(table=TABLE))

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StateNotStored) as caught:
        store.save(BenchState())
    assert caught.value.evidence["reason"] == "No space left on device"
    assert store.load().table == TABLE


def test_a_bench_is_held_by_one_program_and_the_second_is_told_by_whom(tmp_path, somebody):
    who = holder(tmp_path)
    assert who.pid == somebody.pid
    assert "teapot" in who.command
    assert not who.terminates  # it has no handler: SIGTERM would leave the torque on
    with pytest.raises(BenchBusy, match=rf"process {somebody.pid} .*teapot") as caught:
        BenchLock(tmp_path, SystemClock())
    assert caught.value.exit_code == 9
    assert "rig stop" in caught.value.next_step


def test_a_killed_program_holds_nothing_although_its_name_is_still_there(tmp_path, somebody):
    somebody.send_signal(signal.SIGKILL)
    somebody.wait()
    assert str(somebody.pid) in (tmp_path / "lock").read_text()
    assert holder(tmp_path) is None
    BenchLock(tmp_path, SystemClock()).close()
    assert holder(tmp_path) is None


def test_a_holder_without_a_readable_name_is_still_a_holder(tmp_path, somebody):
    (tmp_path / "lock").write_text("{")
    assert holder(tmp_path) == Holder(pid=0, command="", since_utc="")
    with pytest.raises(BenchBusy, match="another process"):
        BenchLock(tmp_path, SystemClock())


def test_nobody_holds_a_bench_that_was_never_used(tmp_path):
    assert holder(tmp_path / "never") is None


def test_a_request_to_stop_from_before_does_not_stop_the_next_program(tmp_path):
    store = FileStore(tmp_path)
    store.request_stop()
    assert store.stop_requested()
    lock = BenchLock(tmp_path, SystemClock())
    assert not store.stop_requested()
    lock.close()


def test_each_bench_has_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "states"))
    assert load_config().state_path("hardware") == tmp_path / "states" / "hbr-rig" / "hardware"
    (tmp_path / "rig.toml").write_text('state_dir = "here"\n')
    assert load_config().state_path("sim") == tmp_path / "here" / "sim"
    assert json.loads(load_config().model_dump_json())["state_dir"] == str(tmp_path / "here")
