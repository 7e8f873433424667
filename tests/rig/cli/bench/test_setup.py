"""`rig setup`, `rig doctor`, `rig find` and `rig servo` on simulated parts."""

import json
import shutil
from contextlib import contextmanager

import pytest
from typer.testing import CliRunner

from rig.bench.hardware import HardwareBench
from rig.cli.main import app
from rig.config import RigConfig, load_config
from tests.rig.doctor.doctor_parts import unopened


@pytest.fixture
def home(tmp_path, monkeypatch):
    """Return an empty folder; there is no configuration of the user."""
    monkeypatch.chdir(tmp_path)
    for name in ("XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME"):
        monkeypatch.setenv(name, str(tmp_path / "home" / name))
    return tmp_path


def rig(*arguments: str, answers: str = ""):
    return CliRunner().invoke(app, list(arguments), input=answers)


@pytest.fixture
def parts(home, monkeypatch):
    """Return a bench whose parts have factory settings; the command line uses it."""
    with unopened() as bench:

        class Kind(HardwareBench):
            @contextmanager
            def computer(self, config, options, seed):
                bench.context.computer._port = config.servo.port
                bench.context.computer.simulated = False  # it stands for a real bench
                yield bench.context.computer

        monkeypatch.setattr("rig.doctor.examination.bench_kind", lambda _: Kind())
        yield bench


# -- set-up -----------------------------------------------------------------------------------------------------------


def test_setup_writes_a_commented_file_that_works(home):
    done = rig("setup", "--bench", "sim")
    assert done.exit_code == 0, done.output
    text = (home / "rig.toml").read_text(encoding="utf-8")
    assert "# cable budget" in text
    config = load_config(home / "rig.toml")
    assert config.default_bench == "sim"
    assert config.servo.port.startswith("/dev/serial/by-id/")
    assert "No problems" in done.stdout
    assert rig("goto", "10", "--json").exit_code == 0
    before = (home / "rig.toml").read_bytes()
    again = rig("setup")
    assert again.exit_code == 0, again.output
    assert "is unchanged" in again.stdout
    assert (home / "rig.toml").read_bytes() == before
    written, examined = (json.loads(line) for line in rig("setup", "--json").stdout.splitlines())
    assert (written["written"], examined["bad"]) == (False, 0)


def test_setup_of_the_simulated_bench_keeps_the_devices_of_the_real_one(home):
    file = home / "rig.toml"
    text = 'default_bench = "sim"\n[servo]\nport = "/dev/ttyUSB3"\n[camera]\nsource = 2\n'
    file.write_text(text, encoding="utf-8")
    done = rig("setup")
    assert done.exit_code == 0, done.output
    assert "These devices are simulated. For the real bench: rig setup --bench hardware" in done.stdout
    assert file.read_text(encoding="utf-8").startswith(text)
    file.write_text(text.replace('default_bench = "sim"\n', ""), encoding="utf-8")
    assert rig("setup", "--bench", "sim").exit_code == 0
    config = load_config(file)
    assert (config.default_bench, config.camera.source, config.servo.port) == ("sim", 2, "/dev/ttyUSB3")


def test_new_file_belongs_to_the_bench_that_was_set_up(parts, home):
    (home / "rig.toml").write_text('default_bench = "sim"\n[table]\nvelocity_dps = 45\n', encoding="utf-8")
    rig("setup", "--config", "real.toml")
    config = load_config(home / "real.toml")
    assert (config.default_bench, config.table.velocity_dps) == ("hardware", 90)
    # The default port is the same device, but the next one that is connected may get its name.
    assert parts.context.computer.serial_ports()[0].path == RigConfig().servo.port != config.servo.port
    rig("setup", "--config", "sim.toml", "--set", "default_bench=sim")
    assert load_config(home / "sim.toml").default_bench == "sim"


def test_existing_file_keeps_comments_and_settings(parts, home):
    file = home / "rig.toml"
    file.write_text(
        '# bench 7\n[servo]\nport = "/dev/ttyUSB0" # red dot\nid = 9  # the old one\n[table]\n'
        "limits_deg = [-400, 400] # measured\n",
        encoding="utf-8",
    )
    done = rig("setup")
    assert file.read_text(encoding="utf-8").startswith(
        '# bench 7\n[servo]\nport = "/dev/ttyUSB0" # red dot\nid = 1  # the old one\n'
    )
    assert "limits_deg = [-400, 400] # measured" in file.read_text(encoding="utf-8")
    assert done.exit_code == 4  # the factory's settings are still in the servo
    assert "rig servo settings --write" in done.stdout


def test_one_of_several_servos_is_not_chosen(parts, home):
    parts.add_servo(7, 1_000_000, "xm430_w350")
    done = rig("setup")
    assert "! Several devices could be the servo; name one in the file." in done.stdout
    assert "\nid =" not in (home / "rig.toml").read_text(encoding="utf-8")


# -- doctor and find --------------------------------------------------------------------------------------------------


def test_doctor_uses_the_defaults_if_the_configuration_is_broken(home):
    (home / "rig.toml").write_text("[servo]\nbaud = 3\nprot = 1\n", encoding="utf-8")
    assert rig("setup", "--bench", "sim").exit_code == 3
    assert (home / "rig.toml").read_text(encoding="utf-8") == "[servo]\nbaud = 3\nprot = 1\n"
    done = rig("doctor", "--bench", "sim")
    assert done.exit_code == 3
    assert done.stdout.count("→ Check the configuration: `rig config check`.") == 2
    assert "XL430-W250" in done.stdout


@pytest.fixture
def found(home):
    """Return a function that runs `rig find`, and reads the settings that it prints."""

    def run(*options: str) -> RigConfig:
        done = rig("find", *options)
        assert done.exit_code == 0
        (home / "found.toml").write_text(done.stdout.partition("`rig setup` writes it):")[2], encoding="utf-8")
        return load_config(home / "found.toml")

    return run


def test_find_prints_valid_settings(parts, found):
    config = found()
    assert (config.servo.baud, config.servo.id, config.imu.address) == (57_600, 1, 0x68)
    reported = json.loads(rig("find", "--json").stdout)
    assert reported["settings"]["camera.source"] == "/dev/v4l/by-id/usb-HD_Webcam-video-index0"
    udev = rig("doctor", "--udev").stdout
    assert all(line.startswith(("#", "ACTION", "SUBSYSTEM")) for line in udev.splitlines())


def test_find_detects_a_rig_head(found):
    config = found("--bench", "sim", "--set", "imu.connection=head")
    assert config.imu.connection == "head"
    assert config.head.port.endswith("SIM00002-if00-port0")


def test_find_on_an_empty_computer_reports_no_device(parts, home):
    for folder in ("sys/class", "dev"):
        shutil.rmtree(parts.computer.root / folder)
    done = rig("find")
    assert done.exit_code == 4
    assert done.stdout.count("→") == 3


# -- servo ------------------------------------------------------------------------------------------------------------


def test_servo_changes_update_the_file(parts, home):
    (home / "rig.toml").write_text("[servo]\nid = 1 # sticker\n", encoding="utf-8")
    assert "verified" in rig("servo", "set-id", "4", "--yes").stdout
    assert rig("servo", "set-baud", "1000000", "--yes").exit_code == 0
    assert (home / "rig.toml").read_text(encoding="utf-8") == "[servo]\nid = 4 # sticker\nbaud = 1000000\n"
    assert "already" in rig("servo", "set-id", "4", "--yes").stdout


def test_missing_or_negative_answer_changes_nothing(parts, home, monkeypatch):
    assert rig("servo", "set-id", "4").exit_code == 2
    monkeypatch.setattr("rig.cli.ui.prompts.is_interactive", lambda: True)
    assert "Nothing was changed." in rig("servo", "set-id", "4", answers="what\nn\n").stderr
    assert parts.devices.servo.memory["ID"] == 1
    assert rig("servo", "set-id", "300", "--yes").exit_code == 2


def test_settings_are_shown_and_written_on_request(parts, home):
    shown = rig("servo", "settings")
    assert shown.exit_code == 4
    assert "Operating Mode: 3 → 4" in shown.stdout
    assert rig("servo", "settings", "--write", "--yes").exit_code == 0
    assert rig("servo", "settings").exit_code == 0
