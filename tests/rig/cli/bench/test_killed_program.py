"""A program is killed, stopped and terminated during a motion of a servo that is simulated in real time."""

import json
import os
import re
import signal
import subprocess
import sys
import urllib.request
from contextlib import suppress
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rig.bench.computer import Computer
from rig.cli.main import app
from rig.config import load_config
from rig.core.clock import SystemClock
from rig.core.errors import DeviceNotFound
from rig.devices.dynamixel.port import GUARDIAN, open_serial
from rig.devices.dynamixel.servo import open_servo
from sim.realtime.wire import send_command
from tests.programs import Program, until
from tests.sim.servo.served import start

pytestmark = pytest.mark.realtime

CLOCK = SystemClock()
JSON = {"Content-Type": "application/json"}

PROGRAM = """
import os
import numpy as np
import typer
from rig.bench import Bench
from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings
from rig.core.clock import SystemClock
from rig.devices.dynamixel.guardian import Guardian
from rig.devices.dynamixel.servo import open_servo
from rig.devices.dynamixel.port import open_serial
from rig.devices.imu import ImuIdentity, ImuSamples
from rig.safety.saved_state import FileStore
from rig.safety.saved_state import BenchLock
from rig.motion.turntable import Turntable

CLOCK = SystemClock()

class StillImu:
    identity = ImuIdentity("none", 0x68, 0x68, 0.005)
    rate_hz, range_dps = 200.0, 250.0

    def __init__(self):
        self.until_ns = CLOCK.now_ns()

    def read_samples(self):
        time_ns = np.arange(self.until_ns, CLOCK.now_ns(), 5_000_000, dtype=np.int64)
        self.until_ns += 5_000_000 * time_ns.size
        return ImuSamples(time_ns, np.zeros((time_ns.size, 3)))

@command
def go(settings: Settings) -> None:
    config = settings.load()
    lock = BenchLock(config.state_path("hardware"), CLOCK)
    bus = open_serial(config.servo.port, config.servo.baud)
    port, guardian = config.servo, None
    if "GUARD" in os.environ:
        guardian = Guardian(port.port, port.baud, port.model, port.id)
    servo = open_servo(bus, port, CLOCK, guardian=guardian)
    servo.prepare(write=True)
    bench = Bench("hardware", config, CLOCK, servo, StillImu, None, state=FileStore(config.state_path("hardware")))
    bench.safety.connect()
    if bench.safety.doubt:
        bench.safety.set_angle(0.0)
    print(*bench.safety.findings, sep="; ", flush=True)
    read_state, reported = servo.read_state, []

    def read_and_report():
        state = read_state()
        if abs(state.velocity_dps) > 30.0 and not reported:
            reported.append(print("moving", flush=True))
        return state

    servo.read_state = read_and_report
    with Turntable(bench, trust_gyro=False) as table:
        table.goto(350.0 if table.rest_deg < 175.0 else 0.0)

app = typer.Typer()
app.command()(go)
app()
"""


@pytest.fixture
def servo(tmp_path):
    """Return the settings of a servo that another process simulates in real time."""
    link = tmp_path / "servo"
    process = start(link)
    yield [
        f"servo.port={str(link)!r}",
        f"state_dir={str(tmp_path / 'state')!r}",
        "table.velocity_dps=60",
        "table.watchdog_s=2.4",
        "servo.retries=20",  # a busy computer pauses the process
    ]
    process.close()


def moving(settings: list[str], **variables: str) -> tuple[Program, str]:
    """Start the program; return it while the table moves, with its findings about the servo."""
    options = [word for setting in settings for word in ("--set", setting)]
    process = Program(*options, code=PROGRAM, **variables)
    findings = process.stdout.readline()
    assert process.stdout.readline() == "moving\n", process.stderr.read()
    return process, findings


def ended(process: Program) -> tuple[int, str]:
    _, errors = process.communicate(timeout=60)
    return process.returncode, errors


def observed(settings: list[str]) -> tuple[bool, bool, bool]:
    """Return whether the servo rotates, whether its torque is on, and whether its watchdog has tripped."""
    config = load_config(None, settings)
    bus = open_serial(config.servo.port, config.servo.baud)
    try:
        servo = open_servo(bus, config.servo, CLOCK)
        first = servo.read_state()
        CLOCK.sleep(0.1)
        rotates = abs(servo.read_state().position_deg - first.position_deg) > 0.3
        condition = servo.read_condition()
        return rotates, condition.torque, condition.watchdog_tripped
    finally:
        bus.close()


def rig(settings: list[str], *words: str):
    options = [word for setting in settings for word in ("--set", setting)]
    return CliRunner().invoke(app, [*words, "--bench", "hardware", *options])


def test_table_stops_however_the_program_ends(servo, tmp_path):
    process, findings = moving(servo)
    assert findings == "\n"
    process.send_signal(signal.SIGKILL)
    ended(process)
    for _ in range(10):  # each look restarts the watchdog, and a busy computer is late
        CLOCK.sleep(load_config(None, servo).table.watchdog_s + 0.3)
        if (seen := observed(servo)) == (False, True, True):
            break
    assert seen == (False, True, True)
    path = json.loads(Path(tmp_path, "state", "hardware", "state.json").read_text())["table"]["path_deg"]
    assert path == pytest.approx([180.0, 530.0], abs=0.5)

    process, findings = moving(servo)  # the next program reports it and continues at the present angle
    for finding in ("torque was on", "watchdog stopped it", "interrupted during a motion"):
        assert finding in findings
    done = rig(servo, "stop", "--json")  # needs only the servo, neither camera nor IMU
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout) == {"bench": "hardware", "pid": process.pid, "ended": True, "torque_was_on": False}
    code, errors = ended(process)
    assert code == 5
    assert "Error 512 (stopped)" in errors
    assert observed(servo) == (False, False, False)

    process, _ = moving(servo)
    process.send_signal(signal.SIGTERM)
    assert ended(process)[0] == 143
    assert observed(servo) == (False, False, False)

    process, _ = moving(servo)
    process.send_signal(signal.SIGINT)
    assert ended(process)[0] == 130
    assert observed(servo) == (False, False, False)

    process, _ = moving(servo)
    process.send_signal(signal.SIGKILL)
    ended(process)
    (tmp_path / "full").write_text("")  # the state cannot be written; the servo is stopped all the same
    result = json.loads(rig([*servo, f"state_dir={str(tmp_path / 'full')!r}"], "stop", "--json").stdout)
    assert (result["pid"], result["torque_was_on"]) == (None, True)
    assert observed(servo) == (False, False, False)


@pytest.mark.parametrize("number", ["SIGKILL", pytest.param("SIGSEGV", marks=pytest.mark.nightly)])
def test_guardian_switches_the_torque_off_of_a_killed_program(servo, number):
    process, _ = moving(servo, GUARD="1")
    process.send_signal(signal.Signals[number])
    ended(process)
    until(lambda: is_torque_off(servo))


def test_next_command_waits_for_the_guardian_of_a_killed_program():
    ours, theirs = os.openpty()  # no servo answers, so the guardian tries for some seconds
    port = os.ttyname(theirs)
    guardian = subprocess.Popen([sys.executable, "-m", GUARDIAN, port, "57600", "xl430", "1"], stdin=subprocess.PIPE)
    guardian.stdin.write(b"1")
    guardian.stdin.close()

    def is_named() -> bool:
        try:
            open_serial(port, 57_600).close()
        except DeviceNotFound as error:
            return "its guardian switches the torque off" in error.next_step
        return False

    try:
        until(is_named)
        Computer().open_serial(port, 57_600).close()
    finally:
        guardian.wait(30.0)
        os.close(ours)
        os.close(theirs)


NIGHTLY = [
    *(["home", "--revolutions", "0"], ["enroll", "cup", "--yes"], ["empty-table"]),
    *(["calibrate", "servo"], ["calibrate", "imu"], ["identify", "--strategy", "sweep"], ["serve", "--port", "0"]),
]


@pytest.mark.parametrize(
    "command", [["goto", "90"], *(pytest.param(words, marks=pytest.mark.nightly) for words in NIGHTLY)], ids=" ".join
)
def test_guardian_switches_the_torque_off_of_each_command_that_moves(running_sim_bench, tmp_path, command):
    # On a busy computer the program that simulates the bench answers late.
    config = ["--config", str(running_sim_bench / "rig.toml"), "--set", "servo.retries=20"]
    done = CliRunner().invoke(app, ["home", "--here", *config])
    assert done.exit_code == 0, done.output
    if command[0] == "identify":
        enroll = ["enroll", "mug-white", "--views", "4", "--yes", "--bench", "sim"]
        done = CliRunner().invoke(app, [*enroll, "--set", f"catalog.path={str(tmp_path / 'catalog')!r}"])
        assert done.exit_code == 0, done.output
        config += ["--set", f"catalog.path={str(tmp_path / 'catalog')!r}"]
    (tmp_path / "here").mkdir()
    for module in ("signal", "subprocess", "rig"):  # no process imports from the folder in which the program runs
        (tmp_path / "here" / f"{module}.py").write_text("open('imported', 'w')")
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", "from rig.cli.main import main; main()", *command, *config],
        cwd=tmp_path / "here",
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    if command[0] == "serve":
        pytest.importorskip("fastapi", reason="the extra hbr-rig[web] is not installed")
        page = next(found[0] for line in process.stdout if (found := re.search(r"http://\S+/", line)))
        job = urllib.request.Request(f"{page}api/v1/jobs", b'{"kind": "goto", "angle_deg": 90}', JSON)
        urllib.request.urlopen(job, timeout=30).close()

    def torque() -> bool:
        return send_command(running_sim_bench, "status")["world"]["torque"]

    # Each answer takes time of the simulated bench.
    until(lambda: torque() or process.poll() is not None, every_s=0.1)
    assert process.poll() is None, process.stdout.read()
    process.kill()
    process.communicate()
    until(lambda: not torque(), every_s=0.1)
    assert not (tmp_path / "here" / "imported").exists()


def is_torque_off(settings: list[str]) -> bool:
    with suppress(DeviceNotFound):  # the guardian has opened the port
        return not observed(settings)[1]
    return False


@pytest.mark.parametrize(
    "numbers",
    [
        ["SIGINT"] * 5,
        *(
            pytest.param(numbers, marks=pytest.mark.nightly)
            for numbers in (
                *(["SIGINT"] * 10, ["SIGTERM"] * 4, ["SIGINT", "SIGTERM"] * 3),
                *([name] for name in ("SIGQUIT", "SIGUSR1", "SIGABRT", "SIGALRM", "SIGXCPU")),
            )
        ),
    ],
    ids="+".join,
)
def test_torque_is_off_after_a_burst_of_signals(servo, numbers):
    process, _ = moving(servo)
    for name in numbers:
        process.send_signal(signal.Signals[name])
        CLOCK.sleep(0.002)
    codes = {130 if name == "SIGINT" else 128 + signal.Signals[name] for name in numbers}
    assert ended(process)[0] in codes
    assert observed(servo) == (False, False, False)
