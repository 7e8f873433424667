"""Changes of the simulated bench: the changed properties, their size, and their seeds."""

import numpy as np
import pytest
from numpy.typing import NDArray

from hbr.drawing.noise import Noise
from rig.bench import Bench
from rig.config import RigConfig
from rig.core.errors import UsageError
from sim.bench import ShelfOperator, open_sim_bench
from sim.change import CHANGES, Change
from sim.noise import NoiseModel
from sim.objects.shelf import shelf
from sim.world import World


def _frame(bench: Bench) -> NDArray[np.uint8]:
    bench.clock.sleep(0.2)
    return bench.camera.capture(bench.clock.now_ns()).image_bgr


def _seen(change: Change, seed: int, name: str | None = "toy-house") -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Frames of one solid before and after a change."""
    world = World(noise=NoiseModel.none(), seed=seed)
    operator = ShelfOperator(world, shelf(), next_object=name, yaw_deg=0.0)
    with open_sim_bench(RigConfig(), operator) as bench:
        frames = []
        for number in range(2):
            operator.clear() if name is None else operator.place(None)
            frames.append(_frame(bench))
            if not number:
                operator.change_bench(change)
        return frames[0], frames[1]


def test_light_change_affects_only_exposure_and_colour() -> None:
    before, after = _seen(CHANGES["light"], seed=1)
    shaded = (before.min(axis=2) > 40) & (before.max(axis=2) < 150)
    gains = after[shaded].astype(float) / before[shaded]
    middle = np.median(gains, axis=0)
    assert np.abs(gains - middle).max() < 0.1  # one factor a channel, everywhere
    assert np.abs(middle - 1).max() > 0.05


def test_hard_change_is_that_of_the_evaluation_and_new_for_each_object() -> None:
    world = World(noise=NoiseModel.none(), seed=3)
    operator = ShelfOperator(world, shelf(), next_object="toy-house", yaw_deg=0.0)
    with open_sim_bench(RigConfig(), operator) as bench:
        operator.place(None)
        before = _frame(bench)
        operator.change_bench(CHANGES["hard"])
        frames = []
        for _ in range(2):
            operator.place(None)
            frames.append(_frame(bench))
        operator.clear()
        empty = _frame(bench)
    assert before[:100].std(axis=(0, 1)).max() < 2
    assert empty[:100].std(axis=(0, 1)).max() > 8
    assert np.abs(frames[0].astype(int) - frames[1]).mean() > 2  # another light and placement
    assert (np.abs(frames[0].astype(int) - empty).max(axis=2) > 40).mean() > 0.05  # the object


def test_changes_are_combined_by_name() -> None:
    assert Change.named([]) is None
    both = Change.named(["light", "placement"])
    assert both is not None
    assert (both.brightness, both.placement_mm) == (CHANGES["light"].brightness, CHANGES["placement"].placement_mm)
    with pytest.raises(UsageError, match="weather"):
        Change.named(["weather"])


@pytest.mark.parametrize("name", ["mb", "gn", "gn-sd"])
def test_papers_noise_is_that_of_the_experiments(name: str) -> None:
    before, after = _seen(CHANGES[name], seed=1)
    noise = Noise.parse({"mb": "mb", "gn": "gn", "gn-sd": "gn:0.000144"}[name])
    expected = noise.apply(before, np.random.default_rng(0))
    if name == "mb":
        assert np.array_equal(after, expected)
    else:  # other random numbers
        own, its = (np.std(image.astype(float) - before) for image in (after, expected))
        assert own == pytest.approx(its, rel=0.02)
