"""The checks of the fuzz targets detect each kind of error."""

import gc
import signal
import subprocess
import sys
from dataclasses import replace

import pytest

from tests.fuzz.commands import Done, check, tree
from tests.fuzzing import MAX_MEMORY, LimitExceeded, limited

GOOD = Done(0, '{"a": 1}\n', "", 1, 0.1)


@pytest.mark.parametrize(
    "bad",
    [
        replace(GOOD, exit_code=1),
        replace(GOOD, exit_code=-9),
        replace(GOOD, exit_code=2, err="Usage error without a next step"),
        replace(GOOD, err="Traceback (most recent call last):"),
        replace(GOOD, memory_bytes=MAX_MEMORY + 1),
        replace(GOOD, out="\x1b[2J"),
        replace(GOOD, out="no JSON\n"),
        replace(GOOD, out="3\n"),
    ],
)
def test_fuzz_check_detects_each_forbidden_end(bad):
    check(GOOD, ("--json",))
    with pytest.raises((AssertionError, ValueError)):
        check(bad, ("--json",))


def test_change_of_the_file_by_another_program_is_noticed(tmp_path):
    (tmp_path / "secret").write_text("a", encoding="utf-8")
    before = tree(tmp_path)
    assert tree(tmp_path) == before
    (tmp_path / "secret").write_text("ab", encoding="utf-8")
    assert tree(tmp_path) != before


@pytest.mark.parametrize(
    ("limit", "code", "exit_code"),
    [("MAX_CPU_S = 1", "while True: pass", -signal.SIGKILL), ("MAX_MEMORY = 1 << 28", "bytearray(1 << 29)", 1)],
)
def test_hangs_and_memory_are_limited(limit, code, exit_code, tmp_path):
    program = (
        "from tests.fuzz import worker; from pathlib import Path; import sys\n"
        f"worker.{limit}\nworker.run(lambda: exec({code!r}), [], Path(sys.argv[1]))"
    )
    (tmp_path / "inside").mkdir()
    done = subprocess.run([sys.executable, "-c", program, str(tmp_path)], check=False)
    assert done.returncode in (exit_code, -signal.SIGXCPU)


def test_hangs_and_memory_are_limited_in_this_process():
    with pytest.raises(LimitExceeded), limited(cpu_s=0.05):
        while True:
            pass
    gc.collect()  # else garbage of other tests may be freed below, which makes room
    with pytest.raises(MemoryError), limited(memory=1 << 24):
        bytearray(1 << 27)  # up to 32 MiB can come from memory that was freed before
    bytearray(1 << 27)
