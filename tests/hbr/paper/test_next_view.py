import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hbr import Ranking, ViewIndex, Views, next_view, retrieve
from tests.fuzzing import examples
from tests.hbr.paper.retrieval_reference import SEVERAL, next_view_reference, similarity, similarity_of_several


@examples(14)
@given(st.integers(0, 2**32 - 1), st.integers(2, 5), st.integers(1, 12), st.integers(1, 12), st.booleans())
def test_equals_the_literal_definition(seed: int, steps: int, objects: int, list_length: int, several: bool) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(objects, 6 * objects + 1))
    owner = np.concatenate([np.arange(objects), rng.integers(0, objects, count - objects)])
    azimuth = (5 * rng.integers(0, 72, count)).astype(np.float64)
    if seed % 2:
        azimuth = rng.uniform(0, 360, count)
    kind, length, alike = (SEVERAL, 288, similarity_of_several) if several else ("cedd", 144, similarity)
    levels = rng.integers(0, 8, (count, length), dtype=np.uint8)
    views = Views(levels, azimuth, owner, tuple(map(str, range(objects))), kind)
    queries = rng.integers(0, 8, (steps, length), dtype=np.uint8)
    ranking = retrieve(queries, rng.integers(-72, 72, steps) * 5.0, ViewIndex(views), list_length=list_length)

    decision = next_view(ranking)
    here = float(ranking.orientation_deg[-1])
    side, rotation_deg, s_left, s_right = next_view_reference(
        views,
        list(zip(ranking.object_index.tolist(), ranking.pose_deg.tolist(), strict=True)),
        ranking.lists[-1].tolist(),
        here,
        ranking.orientation_deg.tolist(),
        alike,
    )
    assert decision.s_left == pytest.approx(s_left, abs=1e-12)
    assert decision.s_right == pytest.approx(s_right, abs=1e-12)
    if abs(s_left - s_right) > 1e-12:
        assert decision.side == side
        assert decision.rotation_deg == pytest.approx(rotation_deg, abs=1e-12)
    assert 0 < abs(decision.rotation_deg) - decision.detour_deg <= 90
    assert (decision.rotation_deg > 0) == (decision.side == "left")
    assert 0 <= decision.orientation_deg < 360
    assert np.cos(np.radians(decision.orientation_deg - here - decision.rotation_deg)) == pytest.approx(1)


def flat(level: int, bin_: int) -> np.ndarray:
    row = np.zeros(144, np.uint8)
    row[bin_] = level
    return row


def pair(similar_on_left: bool, pose_deg: float = 0.0, orientations: tuple[float, ...] = (0.0, 0.0)) -> Ranking:
    """Return a ranking of two objects at `pose_deg`, similar on one side of azimuth 0 and different on the other."""
    descriptors, azimuths, owners = [], [], []
    for owner in (0, 1):
        for azimuth in np.arange(0, 360, 5.0):
            on_left = azimuth < 180
            descriptors.append(flat(4, 1 if on_left == similar_on_left else 2 + owner))
            azimuths.append(azimuth)
            owners.append(owner)
    views = Views(np.array(descriptors), np.array(azimuths), np.array(owners), ("a", "b"))
    rows = [int(np.flatnonzero((views.azimuth_deg == pose_deg) & (views.object_index == j))[0]) for j in (0, 1)]
    return Ranking(
        object_index=np.array([0, 1]),
        scores=np.array([1.0, 0.9]),
        pose_deg=np.full(2, pose_deg),
        paths=np.repeat(np.array(rows)[:, None], len(orientations), axis=1),
        lists=(np.array(rows),) * len(orientations),
        orientation_deg=np.array(orientations),
        views=views,
    )


def test_decision_is_the_side_on_which_the_candidates_differ() -> None:
    decision = next_view(pair(similar_on_left=True))
    assert (decision.side, decision.rotation_deg) == ("right", -45.0)
    assert (decision.s_left, decision.s_right) == (1.0, 0.0)
    assert decision.candidates == (0, 1)
    assert decision.orientation_deg == 315.0
    decision = next_view(pair(similar_on_left=False))
    assert (decision.side, decision.rotation_deg) == ("left", 45.0)


def test_equal_sides_give_left() -> None:
    decision = next_view(pair(similar_on_left=True, pose_deg=90.0, orientations=(0.0, 90.0)))
    assert decision.s_left == decision.s_right == 1.0  # 90 lies between two sectors that look the same
    assert (decision.side, decision.rotation_deg) == ("left", 45.0)


@pytest.mark.parametrize(("pose_deg", "rotation_deg"), [(45.0, 90.0), (50.0, 85.0), (40.0, 95.0), (355.0, 50.0)])
def test_rotation_ends_at_the_next_sector_centre(pose_deg: float, rotation_deg: float) -> None:
    """From a centre to the next one; 5° before a centre the rotation is too small, so the next centre is chosen."""
    decision = next_view(pair(similar_on_left=False, pose_deg=pose_deg, orientations=(200.0, 0.0)))
    assert (decision.side, decision.rotation_deg) == ("left", rotation_deg)


@pytest.mark.parametrize(
    ("visited", "rotation_deg", "detour_deg"),
    [
        ((0.0,), 45.0, 0.0),
        ((34.0,), 45.0, 0.0),
        ((35.0,), 135.0, 90.0),
        ((55.0 - 360.0,), 135.0, 90.0),
        ((45.0, 135.0), 225.0, 180.0),
        ((45.0, 135.0, 225.0), 315.0, 270.0),
        ((45.0, 135.0, 225.0, 315.0), 45.0, 0.0),
    ],
)
def test_visited_orientations_are_avoided(visited: tuple[float, ...], rotation_deg: float, detour_deg: float) -> None:
    decision = next_view(pair(similar_on_left=False, orientations=(*visited, 0.0)))
    assert (decision.rotation_deg, decision.detour_deg) == (rotation_deg, detour_deg)


def test_detour_stays_on_its_side() -> None:
    decision = next_view(pair(similar_on_left=True, orientations=(-45.0, 0.0)))
    assert (decision.side, decision.rotation_deg, decision.orientation_deg) == ("right", -135.0, 225.0)


def test_catalog_of_one_object_gives_left() -> None:
    views = Views.of_object("a", np.ones((4, 144), np.uint8), [0, 90, 180, 270])
    decision = next_view(retrieve(np.ones((2, 144), np.uint8), [0, 90], ViewIndex(views)))
    assert (decision.side, decision.s_left, decision.s_right, decision.candidates) == ("left", 0.0, 0.0, (0,))


def test_one_query_is_rejected() -> None:
    views = Views.of_object("a", np.ones((1, 144), np.uint8), [0])
    with pytest.raises(ValueError, match="needs two queries"):
        next_view(retrieve(np.ones((1, 144), np.uint8), [0], ViewIndex(views)))


def test_given_side_replaces_the_decision_and_keeps_the_step() -> None:
    ranking = pair(similar_on_left=True, pose_deg=20.0)
    decided, forced = next_view(ranking), next_view(ranking, side="left")
    assert decided.side == "right" == next_view(ranking, side="right").side
    assert next_view(ranking, side="right") == decided
    assert forced.side == "left"
    assert forced.rotation_deg > 0 > decided.rotation_deg
    assert (forced.s_left, forced.s_right) == (decided.s_left, decided.s_right)
    with pytest.raises(ValueError, match="left or right"):
        next_view(ranking, side="up")  # type: ignore[arg-type]


@pytest.mark.parametrize("sectors", [2, 3, 4, 8, 16])
def test_rotation_ends_at_a_centre_of_the_sectors(sectors: int) -> None:
    """The only candidate was seen at 7 and 50 degrees, which are no centres."""
    views = Views.of_object("one", np.ones((72, 144), np.uint8), np.arange(72) * 5.0)
    ranking = retrieve(np.ones((2, 144), np.uint8), [7.0, 50.0], ViewIndex(views))
    width_deg = 360 / sectors
    for side in ("left", "right"):
        decision = next_view(ranking, side=side, sectors=sectors)
        ends_deg = ranking.pose_deg[0] + decision.rotation_deg
        assert (ends_deg / width_deg) % 1 == pytest.approx(0.5)
        assert 0 < abs(decision.rotation_deg) - decision.detour_deg <= width_deg


@pytest.mark.parametrize("sectors", [1, 17])
def test_impossible_numbers_of_sectors_are_rejected(sectors: int) -> None:
    views = Views.of_object("one", np.ones((8, 144), np.uint8), np.arange(8) * 45.0)
    ranking = retrieve(np.ones((2, 144), np.uint8), [0.0, 90.0], ViewIndex(views))
    with pytest.raises(ValueError, match="2 to 16"):
        next_view(ranking, sectors=sectors)
