"""The noise model: invalid values are rejected, also by the simulated bench."""

from typing import Any

import pytest

from rig.bench import open_bench
from rig.config import load_config
from rig.core.errors import ConfigError
from sim.noise import NoiseModel


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("backlash_deg", -0.1),
        ("read_noise_e", float("nan")),
        ("gyro_bias_dps", float("inf")),
        ("structure_damping", 1.0),
        ("vignetting", 1.1),
        ("gyro_flicker_dps", (0.1, -0.1, 0.1)),
        ("vignetting", (0.1, 0.1, 0.1)),
    ],
)
def test_invalid_noise_values_are_rejected_by_name(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=name):
        NoiseModel(**{name: value})


def test_model_without_noise_has_no_noise() -> None:
    none = NoiseModel.none()
    assert {getattr(none, name) for name in NoiseModel.__slots__} == {0.0}
    assert none.with_values(backlash_deg=0.5) != none


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("servo.baud=12345", "57600"),
        ("bench.sim.noise.structure_damping=1.5", "structure_damping: Input should be less than 1"),
        ("bench.sim.noise.motion_px=0.5", "noise: motion_px: give a length of at least 1"),
    ],
)
def test_invalid_simulated_bench_is_a_configuration_error(setting: str, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        open_bench("sim", load_config(None, [setting]))
    assert words in str(caught.value.evidence)
