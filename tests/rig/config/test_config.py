"""The configuration: every mistake at once, each with its key."""

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.bench import bench_names, open_bench
from rig.config import RigConfig, load_config
from rig.config.wording import key_info
from rig.core.errors import ConfigError, DeviceNotFound


def test_defaults_are_valid_without_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert load_config() == RigConfig()


def test_all_mistakes_are_reported_with_range_and_suggestion(tmp_path):
    file = tmp_path / "rig.toml"
    file.write_text(
        '[servo]\nbaud = 3\nprot = "/dev/ttyUSB1"\n[table]\nlimits_deg = [0, 90]\nvelocity_dps = -1\n'
        "[identify]\nmax_view = 3\nmax_views = 1\n[camera]\nwidth = 320\n"
        "[view]\nroi = [80, 0, 480, 480]\n",
        encoding="utf-8",
    )
    with pytest.raises(ConfigError) as caught:
        load_config(file)
    mistakes = "\n".join(caught.value.evidence["mistakes"])
    assert len(caught.value.evidence["mistakes"]) == 7
    assert "line 2: servo.baud: must be a whole number from 9600 to 4500000 bit/s (found 3)" in mistakes
    assert "line 3: servo.prot: unknown key; did you mean port?" in mistakes
    assert "table.limits_deg: must span at least one revolution" in mistakes
    assert "line 6: table.velocity_dps: must be a number from 0.1 to 200 °/s (found -1)" in mistakes
    assert "identify.min_views: must not be above max_views, which is 1 (found 2)" in mistakes
    assert "view: roi [80, 0, 480, 480] is not within the camera's frame of 320x480" in mistakes
    assert "identify.max_view: unknown key; did you mean max_views?" in mistakes
    assert caught.value.exit_code == 3


def test_missing_or_invalid_file_raises_config_error(tmp_path):
    with pytest.raises(ConfigError, match="Cannot read"):
        load_config(tmp_path / "none.toml")
    broken = tmp_path / "rig.toml"
    broken.write_text("[servo\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="not a TOML file") as caught:
        load_config(broken)
    assert "line 1" in caught.value.evidence["reason"]


@pytest.mark.parametrize("roi", ["[-1, 0, 9, 9]", "[0, 0, 0, 9]", "[0, 0, 641, 480]", "[0, 1, 640, 480]"])
def test_region_outside_the_frame_is_rejected(roi):
    with pytest.raises(ConfigError, match="1 mistake"):
        load_config(None, [f"view.roi={roi}"])
    assert load_config(None, ["view.roi=[0, 0, 640, 480]"]).view.roi == (0, 0, 640, 480)


@pytest.mark.parametrize(
    ("size", "square"),
    [
        ((640, 480), (80, 0, 480, 480)),
        ((256, 480), (0, 112, 256, 256)),
        ((1280, 720), (280, 0, 720, 720)),
        ((257, 256), (0, 0, 256, 256)),
    ],
)
def test_region_is_the_largest_square_in_the_middle_of_the_frame_if_it_is_not_set(size, square):
    config = load_config(None, [f"camera.width={size[0]}", f"camera.height={size[1]}", "view.min_sharpness=2"])
    assert config.view.roi == square
    assert config.view.min_sharpness == 2
    # Another frame, such as after a calibration was applied, has another region.
    again = RigConfig.model_validate(config.model_dump(exclude_unset=True) | {"camera": {"width": 100, "height": 80}})
    assert again.view.roi == (10, 0, 80, 80)
    assert load_config(None, [f"camera.width={size[0]}", "view.roi=none"]).view.roi is None


def test_overrides_replace_values_of_the_file(tmp_path):
    file = tmp_path / "rig.toml"
    file.write_text("[identify]\nmax_views = 3\n", encoding="utf-8")
    config = load_config(file, ["identify.max_views=5", "servo.port=/dev/ttyACM0", "table.limits_deg=[-720, 720]"])
    assert config.identify.max_views == 5
    assert config.servo.port == "/dev/ttyACM0"
    assert config.table.limits_deg == (-720.0, 720.0)


@given(st.text(max_size=30).filter(lambda text: "=" not in text or text.startswith("=")))
def test_override_without_key_or_value_raises_config_error(text):
    with pytest.raises(ConfigError):
        load_config(None, [text])


def test_paths_are_relative_to_the_file_and_benches_do_not_share_catalogs(tmp_path):
    file = tmp_path / "rig.toml"
    text = 'state_dir = "kept"\ncalibration_dir = "/results"\n[catalog]\npath = "data/objects"\n'
    file.write_text(text, encoding="utf-8")
    assert load_config(file).catalog_path("hardware") == tmp_path / "data" / "objects"
    assert load_config(file).state_path("hardware") == tmp_path / "kept" / "hardware"
    assert load_config(file).calibration_path("hardware") == Path("/results/hardware")
    assert RigConfig().catalog_path("sim") != RigConfig().catalog_path("hardware")


def test_unknown_bench_is_rejected_with_the_known_ones():
    assert {"hardware", "sim"} <= set(bench_names())
    with pytest.raises(ConfigError) as caught:
        open_bench("simm")
    assert "sim" in caught.value.next_step
    with pytest.raises(ConfigError, match="There is no bench 'sin'"):
        open_bench("sim", load_config(None, ["bench.sin.object=dice"]))


def test_mistakes_in_bench_options_name_their_key():
    with pytest.raises(ConfigError) as caught:
        open_bench("sim", load_config(None, ["bench.sim.noise={backlash_degrees=1.0}", "bench.sim.objekt=dice"]))
    mistakes = "\n".join(caught.value.evidence["mistakes"])
    assert "bench.sim.noise: unknown: backlash_degrees" in mistakes
    assert "bench.sim.objekt: unknown key; did you mean object?" in mistakes


@pytest.mark.parametrize("setting", ["servo.port=nowhere", "servo.port=/dev/null"])
def test_missing_servo_of_a_real_bench_is_reported_with_the_parts_to_check(setting):
    with pytest.raises(DeviceNotFound, match="servo") as caught:
        open_bench("hardware", load_config(None, [setting]))
    assert caught.value.next_step


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("table.watchdog_s=0.1", "twice poll_s"),
        ("table.limits_deg=[-1e9, 1e9]", "within ±90000"),
        ("servo.model=xl430-w250", "unknown model; did you mean xl430_w250?"),
        ("servo.model=lx16a", "unknown model; `rig find` names yours"),
    ],
)
def test_settings_beyond_the_servos_limits_are_rejected(setting, words):
    with pytest.raises(ConfigError) as caught:
        load_config(None, [setting, "table.poll_s=0.06"])
    assert words in caught.value.evidence["mistakes"][0]


BEYOND_LIMITS = {
    "deep lists": "[" * 900 + "]" * 900,
    "open lists": "[" * 1900,
    "deep tables": "{a=" * 600 + "1" + "}" * 600,
    "long integer": "9" * 1900,
    "too long": "9" * 5000,
    "two lines": "4\nthe second",
    "carriage return": "4\rthe second",
}


@pytest.mark.parametrize("value", BEYOND_LIMITS.values(), ids=BEYOND_LIMITS)
def test_values_beyond_the_limits_are_config_errors(value):
    with pytest.raises(ConfigError) as caught:
        load_config(None, [f"identify.max_views={value}"])
    assert caught.value.next_step
    assert len(str(caught.value.evidence)) < 300


@pytest.mark.parametrize(
    "text",
    ["a=" + "[" * 40_000 + "]" * 40_000, "a=" + "9" * 5000, ".".join("a" * 49_000) + "=1", "a.b=1\n" * 20_000],
    ids=["deep", "long integer", "dotted key", "too large"],
)
def test_files_beyond_the_limits_are_config_errors(text, tmp_path):
    (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError):
        load_config(tmp_path / "rig.toml")


def test_pipes_and_devices_are_no_configurations(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), Path("/dev/tty"), tmp_path):
        with pytest.raises(ConfigError, match="Cannot read"):
            load_config(path)


@pytest.mark.parametrize(
    "setting", ["table.encoder_harmonics_deg=[1e18, 0, 0, 0]", "servo.gear_ratio=1e-320", "camera.gain=inf"]
)
def test_every_number_has_finite_limits(setting):
    with pytest.raises(ConfigError):
        load_config(None, [setting])


@pytest.mark.parametrize("extreme", ["1e300", "-1e300", "inf", "-inf", "nan"])
def test_no_number_can_be_extreme(extreme):
    names = {info.name for info in key_info(RigConfig) if isinstance(info.default, float) or "a number" in info.allowed}
    assert len(names) > 30
    with pytest.raises(ConfigError) as caught:
        load_config(None, [f"{name}={extreme}" for name in names])
    assert {mistake.partition(":")[0] for mistake in caught.value.evidence["mistakes"]} == names
