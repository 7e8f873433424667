"""A simulated bench in real time as other programs use it: through its folder, its ports and its socket."""

import os
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from errno import EIO
from pathlib import Path

import cv2
import numpy as np
import pytest
import serial
from hypothesis import example, given
from hypothesis import strategies as st
from smbus2 import SMBus, i2c_msg

from rig.bench import open_bench
from rig.cli.ui.settings import Settings
from rig.config import load_config
from rig.core.clock import SystemClock
from rig.core.errors import BenchBusy, ConfigError, DeviceNotFound, EmergencyStop, UsageError
from rig.devices.dynamixel.port import open_serial
from rig.devices.dynamixel.servo import open_servo
from rig.motion.turntable import Turntable
from sim.bench import ShelfOperator
from sim.devices import SimDevices
from sim.faults import Faults
from sim.objects.shelf import shelf
from sim.realtime.bench import RemoteCapture, RemoteI2c, camera_node
from sim.realtime.commands import HELP, Commands
from sim.realtime.pace import RealTime
from sim.realtime.run import run_bench
from sim.realtime.server import MAX_LINE, BenchServer, ClientSession
from sim.realtime.wire import SOCKET, send_command, short_path
from sim.world import World
from tests.contract.heads import needs
from tests.fuzzing import fuzz_settings
from tests.programs import until

CLOCK = SystemClock()
RETRIES = "servo.retries=20"
PATIENT = ("table.watchdog_s=2.5", "head.deadman_s=2.0", RETRIES)
"""Settings with which a busy computer may pause this program and the bench."""
LEFT = {"lock", "rig.toml"}
"""What an ended bench leaves that no program has moved."""


@pytest.fixture
def start(tmp_path) -> Iterator[Callable[..., Path]]:
    """Return a function that runs a bench in a thread of this process, and returns its folder."""
    running: list[tuple[Path, threading.Thread]] = []

    def begin(name: str = "bench", *overrides: str) -> Path:
        folder = tmp_path / name
        thread = threading.Thread(target=run_bench, args=(Settings(overrides=overrides, json=True), folder, None))
        thread.start()
        until(lambda: answers(folder) or not thread.is_alive())
        running.append((folder, thread))
        return folder

    yield begin
    for folder, thread in running:
        with suppress(DeviceNotFound):  # it has ended
            send_command(folder, "quit")
        thread.join()


def answers(folder: Path) -> bool:
    try:
        return "world" in send_command(folder, "status")
    except (DeviceNotFound, FileNotFoundError):
        return False


def error_of(call: Callable[[], object]) -> int | None:
    """Return the number of the system's error that a call ends with."""
    try:
        call()
    except OSError as error:
        return error.errno
    return None


def ping(folder: Path) -> int:
    """Return the servo's id, asked through its port."""
    config = load_config(folder / "rig.toml", (RETRIES,))
    connection = open_serial(config.servo.port, config.servo.baud)
    try:
        return open_servo(connection, config.servo, CLOCK).identity.bus_id
    finally:
        connection.close()


def connected(folder: Path) -> socket.socket:
    client = socket.socket(socket.AF_UNIX)
    with short_path(folder) as path:
        client.connect(f"{path}/{SOCKET}")
    client.settimeout(10.0)
    return client


# -- the folder -------------------------------------------------------------------------------------------------------


def test_benches_have_their_own_folders_and_clean_them(start):
    one, other = start("one"), start("a-folder-whose-name-is-longer-than-the-path-of-a-socket-may-be-" * 3)
    send_command(one, "put", "lamp")
    assert [send_command(folder, "status")["world"]["object"] for folder in (one, other)] == ["lamp", None]
    assert (one / "servo").readlink() != (other / "servo").readlink()
    with pytest.raises(BenchBusy, match="running already"):
        run_bench(Settings(), one, None)
    send_command(one, "quit")
    until(lambda: not answers(one))
    until(lambda: {path.name for path in one.iterdir()} == LEFT)
    assert ping(other) == 1
    with pytest.raises(DeviceNotFound, match="No simulated bench is running"):
        send_command(one, "status")


def test_bench_recognises_the_state_of_a_killed_program(start):
    folder = start("bench", "servo.id=7", "table.limits_deg=[-500, 500]")
    send_command(folder, "quit")
    until(lambda: {path.name for path in folder.iterdir()} == LEFT)
    (folder / "servo").symlink_to("/dev/pts/no-such-terminal")
    left = socket.socket(socket.AF_UNIX)
    with short_path(folder) as path:
        left.bind(f"{path}/{SOCKET}")
    left.close()
    (folder / "computer" / "dev").mkdir(parents=True)
    (folder / "rig.toml").write_text("# mine\n" + (folder / "rig.toml").read_text())
    with pytest.raises(DeviceNotFound, match="No simulated bench is running"):
        send_command(folder, "status")
    assert ping(start("bench")) == 7  # the settings of the first start
    text = (folder / "rig.toml").read_text()
    assert text.startswith("# mine\n")
    assert load_config(folder / "rig.toml").table.limits_deg == (-500, 500)


@pytest.mark.parametrize("content", ["thesis.txt", "rig.toml"])
def test_folder_with_other_files_is_not_changed(tmp_path, content):
    (tmp_path / content).write_text("default_bench = 'hardware'")
    with pytest.raises(UsageError, match="other files"):
        run_bench(Settings(), tmp_path, None)
    assert [path.name for path in tmp_path.iterdir()] == [content]


def test_default_folder_is_the_first_that_is_not_in_use(start, tmp_path, monkeypatch, capsys):
    start("sim-bench")
    monkeypatch.chdir(tmp_path)
    run_bench(Settings(), None, 0.0)
    assert str(tmp_path / "sim-bench-2") in capsys.readouterr().out


def test_configuration_of_another_bench_is_rejected(start):
    """It could name the port of a real servo."""
    folder = start()
    with pytest.raises(ConfigError, match="does not belong") as error:
        open_bench("sim-bench", load_config(None, [f"bench.sim-bench.folder='{folder}'", "servo.port=/dev/ttyUSB0"]))
    assert f"--config {folder / 'rig.toml'}" in error.value.next_step


# -- its ports --------------------------------------------------------------------------------------------------------


def test_unplugged_port_disappears_and_returns_under_its_name(start):
    folder = start()
    before = serial.Serial(str(folder / "servo"), timeout=0.01, exclusive=True)
    with pytest.raises(DeviceNotFound, match="Cannot open"):
        ping(folder)  # another program uses it
    send_command(folder, "unplug")
    with pytest.raises(serial.SerialException):
        until(lambda: bool(before.write(b"1") and before.read()))
    before.close()
    assert not os.path.lexists(folder / "servo")
    send_command(folder, "end", "unplug")
    until((folder / "servo").exists)
    assert ping(folder) == 1


def test_random_bytes_do_not_end_the_bench(start):
    folder = start()
    rng = np.random.default_rng(1)
    port = open_serial(str(folder / "servo"), 57_600)
    port.write(rng.bytes(300) + b"\xff\xff\xfd\0")
    port.close()
    CLOCK.sleep(0.1)  # the bytes take 53 ms on the bus
    for garbage in (b"\n", b"{}\n", b"[" * 5000 + b"\n", rng.bytes(3000), b"x" * (MAX_LINE + 1), b'{"ask": "camera"'):
        with connected(folder) as client:
            client.sendall(garbage + b"\n")
            client.shutdown(socket.SHUT_WR)
            assert client.recv(1) == b""
    until(lambda: answers(folder))
    assert ping(folder) == 1


@pytest.mark.realtime
def test_servo_and_rig_head_are_parts_of_one_world(start, monkeypatch):
    needs("memory")
    monkeypatch.setattr("rig.devices.head.link.REPLY_S", 10.0)  # the bench may have to wait for a processor
    folder = start("bench", "imu.connection=head", "head.power=true", "head.light=0.5", *PATIENT)
    config = load_config(folder / "rig.toml")
    assert not send_command(folder, "status")["world"]["light"][0]
    with open_bench("sim-bench", config) as bench:
        assert send_command(folder, "status")["world"]["light"][0] == pytest.approx(1.0, abs=0.01)
        bench.safety.set_revolutions(0)
        with Turntable(bench) as table:
            move = table.goto(60.0)
        assert move.gyro.angle_deg == pytest.approx(60.0, abs=3.0)
        assert move.rotation_encoder_deg == pytest.approx(60.0, abs=1.0)
        assert send_command(folder, "status")["world"]["table_deg"] == pytest.approx(60.0, abs=1.0)
        send_command(folder, "estop", "press")
        with pytest.raises(EmergencyStop):
            until(lambda: bool(bench.head.check()))
        send_command(folder, "estop", "release")
    send_command(folder, "head", "unplug")
    assert not os.path.lexists(folder / "head")
    with pytest.raises(DeviceNotFound, match="Cannot open the head's port"):
        open_bench("sim-bench", config)


# -- its camera and its I2C bus ---------------------------------------------------------------------------------------


def test_camera_shows_the_world_on_the_clock_of_all_programs(start):
    folder = start()
    camera = RemoteCapture(folder)
    assert camera.set(cv2.CAP_PROP_AUTO_EXPOSURE, 1)
    assert not camera.set(cv2.CAP_PROP_FRAME_WIDTH, 123)
    asked_ns, frames = CLOCK.now_ns(), []
    for command in (["status"], ["put", "lamp", "0"]):
        send_command(folder, *command)
        changed_ns = CLOCK.now_ns() + 33_400_000  # a frame is stamped up to a period after its exposure began
        while camera.grab() and camera.get(cv2.CAP_PROP_POS_MSEC) * 1e6 < changed_ns:
            pass
        ok, image = camera.retrieve()
        assert (ok, image.shape) == (True, (480, 640, 3))
        assert asked_ns < camera.get(cv2.CAP_PROP_POS_MSEC) * 1e6 < CLOCK.now_ns()
        frames.append(image.astype(float))
    assert np.abs(frames[1] - frames[0])[100:400, 250:390].mean() > 10.0

    with pytest.raises(DeviceNotFound, match="camera") as busy:
        RemoteCapture(folder)
    assert busy.value.next_step == "Close the program that uses it."
    send_command(folder, "camera.off")
    assert (camera.isOpened(), camera.grab(), camera_node(folder)) == (True, False, None)
    camera.release()
    with pytest.raises(DeviceNotFound):
        until(lambda: RemoteCapture(folder).isOpened())
    send_command(folder, "end")
    again = RemoteCapture(folder)
    assert again.grab()
    send_command(folder, "quit")
    until(lambda: not again.grab())
    again.release()


def test_i2c_transfers_arrive_as_on_a_bus_of_the_computer(start):
    folder = start()
    remote = RemoteI2c(folder)
    with SMBus(remote.path) as bus:
        assert bus.read_byte_data(0x68, 0x75) == 0x68  # WHO_AM_I
        bus.write_byte_data(0x68, 0x19, 7)
        bus.write_i2c_block_data(0x68, 0x1A, [3, 0x18])
        assert bus.read_i2c_block_data(0x68, 0x19, 3) == [7, 3, 0x18]
        assert bus.read_word_data(0x68, 0x1A) == 0x1803
        answer = i2c_msg.read(0x68, 2)
        bus.i2c_rdwr(i2c_msg.write(0x68, [0x19]), answer)
        assert list(answer) == [7, 3]
        with pytest.raises(OSError, match="No such device or address"):
            bus.read_byte(0x50)
        send_command(folder, "imu.off")
        with pytest.raises(OSError, match="No such device or address"):
            bus.read_byte_data(0x68, 0x75)
        send_command(folder, "quit")
        until(lambda: error_of(lambda: bus.read_byte_data(0x68, 0x75)) == EIO)  # the bench answers until it has ended
    remote.close()


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4),
    max_leaves=8,
)
REQUESTS = st.one_of(
    ANYTHING,
    st.fixed_dictionaries({"ask": st.just("do"), "words": st.lists(st.sampled_from(HELP.split()), max_size=4)}),
    st.fixed_dictionaries(
        {
            "ask": st.just("camera"),
            "call": st.sampled_from(["open", "node", "isOpened", "get", "set", "grab", "retrieve", "release"]),
            "given": st.lists(st.integers() | st.floats() | ANYTHING, max_size=2),
        },
    ),
    st.fixed_dictionaries(
        {
            "ask": st.just("i2c"),
            "messages": st.lists(st.lists(st.integers(-1, 300) | st.just("00ff") | ANYTHING, max_size=3)) | ANYTHING,
        },
    ),
)


@pytest.fixture(scope="module")
def session(tmp_path_factory) -> Iterator[ClientSession]:
    world = World()
    with SimDevices.connected(load_config(None, ()), world) as devices:
        commands = Commands(ShelfOperator(world, shelf()), devices, Faults(devices))
        with BenchServer(tmp_path_factory.mktemp("fuzz"), devices, RealTime(world.clock), commands) as server:
            yield ClientSession(server)


@fuzz_settings(0.3)
@given(request_=REQUESTS)
@example(request_={"ask": "i2c", "messages": [[0x68, 10**12]]})
@example(request_={"ask": "i2c", "messages": [[0x68, "00"], [0x68, 8]]})
@example(request_={"ask": "camera", "call": "set", "given": [10**30, 1e999]})
@example(request_={"ask": "do", "words": []})
def test_any_request_is_answered_or_rejected(session, request_):
    try:
        answer, payload = session.answer(request_)
    except (ValueError, OverflowError):
        return
    assert isinstance(payload, bytes)
    assert isinstance(answer, dict)


# -- the trainee's commands -------------------------------------------------------------------------------------------


@pytest.fixture
def commands() -> Iterator[Commands]:
    world = World()
    with SimDevices.connected(load_config(None, ()), world) as devices:
        yield Commands(ShelfOperator(world, shelf()), devices, Faults(devices))


def test_each_command_changes_the_world(commands):
    commands.do(["put", "lamp", "30"])
    commands.do(["light", "0.5"])
    commands.do(["rotate", "-30"])
    commands._world.clock.sleep(2.0)
    commands.do(["jam"])
    commands.do(["camera.off@3s+2s"])
    assert commands.state()["faults"] == ["jam"]
    commands._world.clock.sleep(3.5)
    assert commands.state() == {
        "object": "lamp",
        "object_deg": 30.0,
        "table_deg": pytest.approx(-30.0, abs=1.0),
        "torque": False,
        "light": [0.5, 0.5, 0.5],
        "faults": ["jam", "camera.off"],
    }
    assert "jam, camera.off" in commands.do(["status"])
    with pytest.raises(UsageError, match="already there"):
        commands.do(["jam"])
    commands.do(["end", "jam"])
    commands.do(["end"])
    commands.do(["clear"])
    assert (commands.state()["faults"], commands.state()["object"]) == ([], None)
    assert "lamp" in commands.do(["objects"]).splitlines()
    assert commands.do(["help"]) == commands.do([]) == HELP
    servo = commands._devices.servo
    servo.memory["Torque Enable"] = 1
    servo._on_torque_enable()
    with pytest.raises(UsageError, match="holds the table"):
        commands.do(["rotate", "90"])


@pytest.mark.parametrize(
    ("words", "step"),
    [
        (["put"], "Write: put NAME [DEGREES]"),
        (["put", "nothing"], "objects"),
        (["put", "lamp", "nan"], "number"),
        (["rotate", "fast"], "number"),
        (["light", "-1"], "0 (dark) or more"),
        (["jamm"], "Did you mean jam? For a list of all commands: rig sim-bench help"),
        (["jam:x=1"], "Remove the parameter"),
        (["jam@move3"], "jam@5s"),
        (["disk_full"], "rig demo --fault disk_full"),
        (["end", "jam"], "No simulated fault is there"),
        (["estop", "press"], "imu.connection=head"),
    ],
)
def test_impossible_command_names_the_next_step(commands, words, step):
    with pytest.raises(UsageError) as error:
        commands.do(words)
    assert step in error.value.next_step
