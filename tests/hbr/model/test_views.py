from typing import Any

import numpy as np
import pytest

from hbr import Views


def make(**changed: Any) -> Views:
    columns: dict[str, Any] = {
        "descriptors": np.arange(3 * 144, dtype=np.uint8).reshape(3, 144) % 8,
        "azimuth_deg": np.array([0.0, 90.0, 355.0]),
        "object_index": np.array([1, 0, 1]),
        "object_names": ("cup", "duck"),
    }
    return Views(**(columns | changed))


def test_azimuths_are_wrapped() -> None:
    assert make(azimuth_deg=np.array([-5.0, 360.0, 725.0])).azimuth_deg.tolist() == [355.0, 0.0, 5.0]


def test_arrays_are_read_only_inside_and_writeable_outside() -> None:
    descriptors = np.zeros((3, 144), np.uint8)
    views = make(descriptors=descriptors)
    for column in (views.descriptors, views.azimuth_deg, views.object_index):
        with pytest.raises(ValueError, match="read-only"):
            column[0] = 1
    descriptors[0] = 1


def test_views_of_an_object_are_found() -> None:
    views = make()
    assert views.of(0).tolist() == [1]
    assert views.of(1).tolist() == [0, 2]
    rows, begin = views.of_each(np.array([1, 0]))
    assert (rows.tolist(), begin.tolist()) == ([0, 2, 1], [0, 2])


def test_object_may_have_no_views() -> None:
    assert make(object_names=("cup", "duck", "fox")).of(2).tolist() == []


def test_concatenation_merges_objects_of_the_same_name() -> None:
    more = Views.of_object("duck", np.full((2, 144), 7, np.uint8), [10, -10])
    other = Views.of_object("fox", np.full((1, 144), 3, np.uint8), [20])
    joined = Views.concatenate([make(), other, more])
    assert joined.object_names == ("cup", "duck", "fox")
    assert joined.object_index.tolist() == [1, 0, 1, 2, 1, 1]
    assert joined.azimuth_deg.tolist() == [0, 90, 355, 20, 10, 350]
    assert (joined.descriptors[:3] == make().descriptors).all()
    assert (joined.descriptors[4:] == 7).all()


def test_concatenation_of_nothing_is_empty() -> None:
    assert len(Views.concatenate([])) == len(Views.empty()) == 0
    assert Views.concatenate([Views.empty(), make()]).object_names == ("cup", "duck")


def test_selection_keeps_the_objects() -> None:
    selected = make().select(np.array([False, True, False]))
    assert selected.object_names == ("cup", "duck")
    assert selected.object_index.tolist() == [0]
    assert selected.azimuth_deg.tolist() == [90]


@pytest.mark.parametrize(
    ("changed", "error", "message"),
    [
        ({"descriptors": np.zeros((3, 144))}, TypeError, "uint8"),
        ({"descriptors": [[0] * 144] * 3}, TypeError, "list"),
        ({"descriptors": np.zeros((3, 54), np.uint8)}, ValueError, r"\(n, 144\)"),
        ({"descriptors": np.full((3, 144), 8, np.uint8)}, ValueError, "level of 8"),
        ({"azimuth_deg": np.zeros(2)}, ValueError, "azimuth_deg has shape"),
        ({"azimuth_deg": np.array([0, np.nan, 0])}, ValueError, "view 1 is not finite"),
        ({"azimuth_deg": np.array([0, 0, np.inf])}, ValueError, "view 2 is not finite"),
        ({"object_index": np.array([0, 1])}, ValueError, "object_index has shape"),
        ({"object_index": np.array([0.0, 1.0, 1.0])}, TypeError, "integers"),
        ({"object_index": np.array([0, 1, 2])}, ValueError, "spans 0..2 but there are 2 names"),
        ({"object_index": np.array([0, 1, -1])}, ValueError, "spans -1..1"),
        ({"object_names": ("cup", "cup")}, ValueError, "'cup' occurs twice"),
    ],
)
def test_invalid_arguments_are_rejected(changed: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        make(**changed)
