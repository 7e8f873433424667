"""Waiting for the next object with the camera."""

import numpy as np
import pytest

from hbr.evaluation.photographs import load_coil
from rig.config import ViewConfig
from rig.core.errors import DeviceSilent
from rig.views.object_presence import TableWatcher, is_empty_table, probability_of_nothing
from sim.motion import rest
from sim.objects.shelf import shelf


def at(s, seconds, action):
    s.world.clock.call_at(s.world.clock.now_ns() + round(seconds * 1e9), action)


def put(s, name, yaw_deg=0.0):
    return lambda: s.world.put(shelf()[name] if name else None, yaw_deg)


def seconds(s, watcher):
    """Return how long the watcher waits, in seconds."""
    start_ns = s.world.clock.now_ns()
    watcher.place(None)
    return (s.world.clock.now_ns() - start_ns) * 1e-9


def test_watcher_waits_until_the_object_is_still(simulated):
    s = simulated()
    watcher = TableWatcher(s.bench)
    at(s, 5.0, put(s, "lamp"))
    at(s, 6.0, put(s, "lamp", 40.0))  # a hand still pushes it
    at(s, 7.0, put(s, "toy-car", 10.0))
    assert 8.5 <= seconds(s, watcher) <= 10.5


def test_object_is_new_if_it_is_another_one_or_follows_an_empty_table(simulated):
    s = simulated()
    watcher = TableWatcher(s.bench)
    at(s, 1.0, put(s, "toy-car"))
    watcher.place(None)
    at(s, 20.0, put(s, "clock"))
    assert 21.0 <= seconds(s, watcher) <= 23.5
    at(s, 10.0, put(s, None))
    at(s, 15.0, put(s, "clock"))
    assert 16.0 <= seconds(s, watcher) <= 18.5


def test_empty_table_and_changing_illumination_are_not_an_object(simulated):
    s = simulated()
    watcher = TableWatcher(s.bench)
    at(s, 1.0, put(s, "radio"))
    watcher.place(None)
    at(s, 5.0, put(s, None))
    for k in range(10):
        level = 1.0 - 0.02 * k
        at(s, 10.0 + 3 * k, lambda level=level: s.world.change(light=(level, level, level)))
    at(s, 60.0, put(s, "dice"))
    assert 61.0 <= seconds(s, watcher) <= 63.5


def test_smallest_objects_are_detected(simulated):
    for name in ("dice", "candle"):
        s = simulated()
        watcher = TableWatcher(s.bench)
        at(s, 2.0, put(s, name))
        assert seconds(s, watcher) <= 6.0


def test_object_to_be_enrolled_is_there_already(simulated):
    s = simulated()
    start_ns = s.world.clock.now_ns()
    TableWatcher(s.bench).place("lamp")
    assert s.world.clock.now_ns() == start_ns


def test_unplugged_camera_ends_the_waiting(simulated):
    s = simulated()
    at(s, 5.0, s.operator.devices.camera.unplug)
    with pytest.raises(DeviceSilent):
        TableWatcher(s.bench).place(None)


def frame(s):
    s.bench.clock.sleep(0.2)
    return s.bench.camera.capture(s.bench.clock.now_ns()).image_bgr


def test_empty_table_is_recognised_in_any_light_but_only_with_its_image(simulated):
    s = simulated()
    config, empty = s.bench.config.view, frame(s)
    for light in ((1.0, 1.0, 1.0), (0.7, 0.7, 0.7), (1.3, 1.3, 1.3), (1.1, 1.0, 0.9)):
        s.world.change(light=light)
        assert is_empty_table(frame(s), empty, config)
    assert not is_empty_table(frame(s), None, config)
    assert not is_empty_table(frame(s), empty[:-1], config)
    s.operator.devices.camera.backdrop[:] = 120
    assert is_empty_table(frame(s), None, config)  # the whole frame has one colour
    put(s, "dice")()
    assert not is_empty_table(frame(s), None, config)
    another = np.random.default_rng(0).integers(0, 256, empty.shape, np.uint8)
    assert not is_empty_table(frame(s), another, config)


def test_no_object_is_taken_for_an_empty_table(simulated):
    s = simulated()
    config, empty = s.bench.config.view, frame(s)
    without = frame(s).astype(np.float32)
    for number, name in enumerate(shelf()):
        put(s, name, 31.0 * number)()
        seen = frame(s)
        faint = without + 0.15 * (seen.astype(np.float32) - empty)  # an object with a seventh of the contrast
        assert not is_empty_table(seen, empty, config), name
        assert not is_empty_table(np.clip(faint, 0, 255).astype(np.uint8), empty, config), name
    small = without.copy()
    small[120:127, 150:157] += 25.0  # 7 mm
    assert not is_empty_table(np.clip(small, 0, 255).astype(np.uint8), empty, config)
    pale = without.copy()
    pale[60:180, 90:210] *= 1.2
    pale[60:180, 90:210] += 2.0
    assert not is_empty_table(np.clip(pale, 0, 255).astype(np.uint8), empty, config)


def rotated_frames(s, angles_deg, lights=((1.0, 1.0, 1.0),)):
    """Return a frame at each table angle, each in the next light."""
    images = []
    for n, angle_deg in enumerate(angles_deg):
        s.world.change(light=lights[n % len(lights)])
        s.world.drive(rest(s.world.clock.now_ns() * 1e-9, angle_deg))
        images.append(frame(s))
    return images


def emptiness(s, images):
    return [probability_of_nothing(images[0], later, s.bench.config.view) for later in images[1:]]


@pytest.mark.parametrize("seed", range(3))
def test_rotation_shows_that_the_table_is_empty_in_any_light(simulated, seed):
    s = simulated(seed=seed)
    lights = ((1.0, 1.0, 1.0), (0.75, 0.75, 0.75), (1.2, 1.1, 1.0))
    assert None not in emptiness(s, rotated_frames(s, (0.0, 30.0, 90.0), lights))


def test_rotation_leaves_it_open_if_the_platter_has_marks_or_the_surroundings_move(simulated):
    s = simulated()
    first, rotated = rotated_frames(s, (0.0, 90.0))
    marked = rotated.copy()
    marked[180:186, 150:160] = 200
    assert emptiness(s, [first, marked, np.roll(rotated, 40, axis=1)]) == [None, None]


@pytest.mark.parametrize("light", [pytest.param((1.0, 1.0, 1.0), marks=pytest.mark.nightly), (0.5, 0.5, 0.5)])
def test_no_object_is_taken_for_nothing_although_it_looks_the_same_from_all_sides(simulated, light):
    s = simulated()
    for number, name in enumerate(shelf()):
        put(s, name, 31.0 * number)()
        first, rotated, again = rotated_frames(s, (0.0, 30.0, 0.0), (light,))
        assert emptiness(s, [first, rotated, again]) == [None, None], name


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["coil-100", "eth-80"])
def test_no_photographed_object_is_taken_for_nothing(rig_test_data, name):
    dataset, config, rng = load_coil(rig_test_data / name), ViewConfig(roi=None), np.random.default_rng(0)
    for j, item in enumerate(dataset.objects):
        for start in range(0, len(item.photographs), len(item.photographs) // 4):
            first = dataset.image(j, start)
            later_deg = (item.azimuth_deg - item.azimuth_deg[start]) % 360
            rotated = dataset.image(j, int(np.argmin(np.abs(later_deg - 30.0))))
            again = np.clip(first + rng.normal(0, 1.5, first.shape), 0, 255).astype(np.uint8)
            dimmed = np.clip(0.7 * rotated, 0, 255).astype(np.uint8)
            for later in (rotated, dimmed, again):  # the last one: an object that is the same from all sides
                assert probability_of_nothing(first, later, config) is None, (item.name, start)
