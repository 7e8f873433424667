"""`rig config ...` on the command line."""

import json
import re
import tomllib
from dataclasses import replace
from datetime import timedelta
from operator import attrgetter

import pytest

from rig.bench import bench_kind, bench_names, check_config
from rig.calibrations import CalibrationStore
from rig.config import RigConfig, load_config
from rig.config.values import read_values
from rig.config.wording import blank_file, key_info
from rig.core.clock import SystemClock
from tests.rig.calibrations.test_calibrations import RESULT


@pytest.fixture
def rig(rig, tmp_path, monkeypatch):
    """Return a function that runs `rig ...` in an empty folder, with no configuration of the user's."""
    (tmp_path / "rig.toml").unlink()
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "home"))
    return rig


def test_check_lists_all_mistakes(rig, tmp_path):
    (tmp_path / "rig.toml").write_text(
        "[bench.sim]\nobjekt = 1\n[bench.sin]\nx = 1\n[imu]\nbus = [1]\nrange_dps = 300\n"
        '[table]\nlimits_deg = ["a", 3]\n[camera]\nexposure_us = -1\nheigth = 3\n',
        encoding="utf-8",
    )
    done = rig("config", "check", "--set", "identify.margin=-1", "--set", "servo.id=none")
    assert done.exit_code == 3
    for line in (
        "line 2: bench.sim.objekt: unknown key; did you mean object?",
        "line 3: bench.sin: There is no bench 'sin'. Did you mean sim?",
        'line 6: imu.bus: must be a whole number or a text in "quotes" (found [1])',
        "imu.range_dps: must be one of 250, 500, 1000, 2000 °/s (found 300)",
        "table.limits_deg: must be [a number, a number] ° (found ['a', 3])",
        "camera.exposure_us: must be a number from 1 to 1000000 µs, or none (found -1)",
        "line 12: camera.heigth: unknown key; did you mean height?",
        "identify.margin: must be a number from 0 to 1 (found -1)",
        "servo.id: must be a whole number from 0 to 252 (found 'none')",
    ):
        assert line in done.stderr
    assert "9 mistakes in rig.toml" in done.stderr


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[servo]\nmodel = "MX-28(2.0)"\n', "servo.model: unknown model; did you mean mx_28?"),
        ('[servo]\nmodel = "PH54-200-S500-R"\n', "servo.model: unknown model; did you mean ph54_200_s500?"),
        ('[servo]\nport = "x\n', "at line 2"),
    ],
)
def test_mistake_is_explained(rig, tmp_path, text, words):
    (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
    done = rig("config", "check")
    assert done.exit_code == 3
    assert words in done.stderr
    (tmp_path / "rig.toml").write_text("[servo]\nid = 4\n", encoding="utf-8")
    assert rig("config", "check").stdout == "rig.toml: no mistakes, 1 key given.\n"


def test_comments_of_a_new_file_hold_the_defaults(tmp_path):
    text = blank_file(RigConfig)
    assert "# baud rate; the servo's factory setting is 57600 (a whole number from 9600 to 4500000 bit/s)" in text
    uncommented = re.sub("^#(?=[a-z])", "", text, flags=re.MULTILINE)
    for given in (text, re.sub("^.*=$", "", uncommented, flags=re.MULTILINE)):
        (tmp_path / "new.toml").write_text(given, encoding="utf-8")
        assert load_config(tmp_path / "new.toml") == RigConfig()


def test_show_prints_toml_with_the_source_of_each_value(rig, tmp_path):
    (tmp_path / "rig.toml").write_text('[servo]\nid = 4\n[bench.sim]\nobject = "dice"\n', encoding="utf-8")
    done = rig("config", "show", "--set", "servo.baud=115200")
    assert done.exit_code == 0
    shown = tomllib.loads(done.stdout)
    assert (shown["servo"]["id"], shown["servo"]["baud"], shown["bench"]["sim"]["object"]) == (4, 115200, "dice")
    reported = json.loads(rig("config", "show", "servo", "--set", "servo.baud=115200", "--json").stdout)["keys"]
    origins = [reported[key]["origin"] for key in ("servo.id", "servo.baud", "servo.port")]
    assert origins == ["rig.toml line 2", "--set", "default"]
    assert reported["servo.baud"]["unit"] == "bit/s"
    assert "table.zero_deg" not in reported
    assert "Did you mean servo.port?" in rig("config", "show", "servo.prot").stderr


def test_show_reports_calibrations_in_force(rig, tmp_path):
    """The gyro's scale of a calibration is in force; the file overrides that of the backlash, and --set the file."""
    (tmp_path / "rig.toml").write_text(
        'default_bench = "sim"\ncalibration_dir = "calibrations"\n[table]\nbacklash_deg = 0.3\n', encoding="utf-8"
    )
    settings = {"imu.scale": 1.02, "table.backlash_deg": 0.2, "view.roi": [0, 0, 100, 100]}
    days = {"view.roi": 1}  # this calibration is no longer valid
    for key, value in settings.items():
        result = replace(
            RESULT,
            name=key,
            when_utc=SystemClock().utc() - timedelta(days=2),
            device={"bench": "sim", "imu": {"axis": "z", "sign": 1}},
            settings={key: value},
            valid_days=days.get(key, 30),
        )
        CalibrationStore(tmp_path / "calibrations" / "sim").add(result)
    arguments = ("config", "show", "--set", "table.backlash_deg=0.4")
    keys = json.loads(rig(*arguments, "--json").stdout)["keys"]
    assert [keys[key]["value"] for key in settings] == [1.02, 0.4, [80, 0, 480, 480]]
    assert keys["imu.scale"]["origin"].startswith("imu.scale@")
    assert [keys[key]["origin"] for key in ("table.backlash_deg", "view.roi")] == ["--set", "default"]
    assert tomllib.loads(rig(*arguments).stdout)["imu"]["scale"] == 1.02


OPTIONAL = [
    (name, key)
    for name, model in (("", RigConfig), *((f"bench.{name}.", bench_kind(name).options) for name in bench_names()))
    for key in key_info(model)
    if key.allowed.endswith("or none")
]
"""All keys that can be none, with the prefix of their section."""
assert {"camera.exposure_us", "view.roi", "bench.sim.object"} <= {f"{above}{info.name}" for above, info in OPTIONAL}


@pytest.mark.parametrize(("above", "info"), OPTIONAL, ids=[f"{above}{info.name}" for above, info in OPTIONAL])
def test_every_optional_key_can_be_none(rig, tmp_path, above, info):
    name = f"{above}{info.name}"

    def value(*overrides):
        config, options = check_config(read_values(None, overrides))
        return attrgetter(".".join(info.key))(options[above.split(".")[1]] if above else config)

    assert value(f"{name}=none") is None
    assert rig("config", "set", name, "none").exit_code == 0
    assert value() is None
    (tmp_path / "rig.toml").write_text(rig("config", "show", name).stdout, encoding="utf-8")  # it can be read again
    assert value() is None


def test_show_begins_with_the_file_in_force(rig, tmp_path):
    assert rig("config", "show").stdout.startswith("# no file: the defaults. Looked for: rig.toml, ")
    (tmp_path / "home" / "hbr-rig").mkdir(parents=True)
    (tmp_path / "home" / "hbr-rig" / "rig.toml").write_text("")
    assert rig("config", "show").stdout.splitlines()[0] == f"# {tmp_path / 'home' / 'hbr-rig' / 'rig.toml'}"
    (tmp_path / "rig.toml").write_text("")
    assert json.loads(rig("config", "show", "--json").stdout)["path"] == "rig.toml"


def test_set_changes_one_line_or_nothing(rig, tmp_path):
    file = tmp_path / "rig.toml"
    file.write_text("[servo] # the red one\nid = 4 # sticker\n", encoding="utf-8")
    assert rig("config", "set", "servo.port", "/dev/ttyACM0").exit_code == 0
    assert file.read_text(encoding="utf-8") == '[servo] # the red one\nid = 4 # sticker\nport = "/dev/ttyACM0"\n'
    before = file.read_bytes()
    rejected = rig("config", "set", "servo.id", "900")
    assert rejected.exit_code == 3
    assert "from 0 to 252" in rejected.stderr
    assert "rig.toml is unchanged: it would have mistakes." in rejected.stderr
    assert "    servo.id: must be a whole number from 0 to 252 (found 900)" in rejected.stderr
    assert rig("config", "set", "servo.prot", "x").exit_code == 3
    assert "servo: must be a section with keys (found 'x')" in rig("config", "set", "servo", "x").stderr
    fault = rig("config", "set", "bench.sim.faults", '["jam@never"]')
    assert fault.exit_code == 3
    assert "bench.sim.faults: Cannot read the fault 'jam@never'." in fault.stderr
    assert file.read_bytes() == before
    assert rig("config", "set", "table.limits_deg", "[-720, 720]").exit_code == 0
    assert rig("config", "set", "table.zero_deg", "-3").exit_code == 0
    assert load_config(file).table.zero_deg == -3
