"""The firmware: generated files are current, it builds without warnings, fits into the board, and passes its tests."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sim.head import build
from tests.firmware import avr

FIRMWARE = build.FIRMWARE


def make(tmp_path: Path, *targets: str) -> str:
    done = subprocess.run(
        ["make", "-C", str(FIRMWARE), f"OUT={tmp_path}", *targets], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "warning" not in done.stderr
    return done.stdout


@pytest.fixture
def compiler():
    if lacking := build.missing():
        pytest.skip(lacking)


def test_generated_files_agree_with_the_table():
    done = subprocess.run(
        [sys.executable, str(FIRMWARE / "generate.py"), "--check"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout


def test_core_passes_its_own_tests_under_sanitizers(compiler, tmp_path):
    probe = tmp_path / "probe.c"
    probe.write_text("int main(void) { return 0; }\n")
    flags = ["-fsanitize=address,undefined", "-o", str(tmp_path / "probe"), str(probe)]
    if subprocess.run([build.compiler(), *flags], capture_output=True, check=False).returncode:
        pytest.skip("this compiler has no sanitizers: apt-get install gcc")
    assert "checks passed" in make(tmp_path, "test")


def test_core_builds_without_a_warning_on_this_machine(compiler, tmp_path):
    make(tmp_path, "host")
    assert (tmp_path / "libhead.so").is_file()


def test_avr_build_fits_its_limits(tmp_path):
    if lacking := avr.missing():
        pytest.skip(lacking)
    reported = make(tmp_path, "avr", "size")
    sizes = re.search(r"flash (\d+) of (\d+) bytes, RAM (\d+) of (\d+) bytes", reported)
    assert sizes
    flash, flash_limit, ram, ram_limit = map(int, sizes.groups())
    assert (flash_limit, ram_limit) == (8192, 1024)
    assert 0 < flash <= flash_limit
    assert 0 < ram <= ram_limit
    assert avr.image() == (tmp_path / "head.bin").read_bytes()  # the emulator runs the same bytes


def test_core_needs_no_heap_and_no_floating_point(tmp_path):
    if lacking := avr.missing():
        pytest.skip(lacking)
    make(tmp_path, "avr")
    symbols = subprocess.run(
        [shutil.which("avr-nm") or "avr-nm", str(tmp_path / "head.elf")], capture_output=True, text=True, check=True
    ).stdout
    names = {line.split()[-1] for line in symbols.splitlines()}
    assert not names & {
        "malloc",
        "free",
        "realloc",
        "__heap_start_used",
        "__mulsf3",
        "__addsf3",
        "__divsf3",
        "__fixsfsi",
    }


def test_missing_compiler_is_reported_with_the_packages_to_install(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda _name: None)
    monkeypatch.delenv("CC", raising=False)
    assert "apt-get install" in build.missing()
    with pytest.raises(Exception, match="cannot be built") as caught:
        build.made()
    assert "imu.connection=i2c" in caught.value.next_step
