"""The space in which views are compared."""

import numpy as np
import pytest

from hbr import Views
from hbr.dense import space
from hbr.dense.space import Space, unit_rows
from hbr.model.views import PackedViews
from tests.hbr.dense.searches import LIGHT, catalog

KINDS = ["cedd", LIGHT, "edges+colours+cedd+network", "edges=0.4,network=0.6"]


def z_of(views: Views, made: Space | None = None) -> np.ndarray:
    """Return z of all views with each other."""
    made = made or Space(views)
    vectors = made.vectors(views.descriptors)
    return made.standardised(vectors @ vectors.T)


@pytest.mark.parametrize("kind", [*KINDS, "cedd-blurred"])  # nothing is known of the last one before the enrollment
def test_equal_views_have_the_largest_z(kind: str) -> None:
    views = catalog(6, kind=kind)
    made = Space(views)
    vectors = made.vectors(views.descriptors)
    assert vectors.dtype == np.float32
    z = z_of(views)
    np.testing.assert_allclose(np.diag(z), made.largest.sum() - made.usual.sum(), rtol=1e-4)
    assert (z.argmax(axis=1) == np.arange(len(views))).all()
    np.testing.assert_allclose(made.similarity(np.diag(z)), 1, rtol=1e-4)
    added = np.add.reduceat(vectors[0] * vectors[0], made.begin)
    np.testing.assert_allclose(added, made.largest, rtol=1e-4)


def test_z_of_different_objects_has_the_mean_0_and_the_standard_deviation_1(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(space, "_PRIOR_OBJECTS", 0.0)  # of the drawn objects alone
    views = catalog(60, step_deg=90.0)
    z = z_of(views)[views.object_index[:, None] != views.object_index]
    assert z.mean() == pytest.approx(0, abs=0.01)
    assert z.std() == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("kind", KINDS)
def test_one_view_alone_has_a_space(kind: str) -> None:
    views = catalog(1, kind=kind, step_deg=360.0)
    other = catalog(1, kind=kind, seed=1, step_deg=360.0)
    made = Space(views)
    enrolled, query = made.vectors(views.descriptors), made.vectors(other.descriptors)
    assert np.isfinite(enrolled).all()
    assert made.standardised(enrolled @ enrolled.T)[0, 0] > made.standardised(enrolled @ query.T)[0, 0]


def test_the_order_of_the_views_changes_nothing() -> None:
    views = catalog(6)
    order = np.random.default_rng(1).permutation(len(views))
    np.testing.assert_allclose(z_of(views)[np.ix_(order, order)], z_of(views.select(order)), atol=1e-3)


def test_packed_views_have_the_same_space() -> None:
    views = catalog(3)
    packed = PackedViews(views.packed(), views.azimuth_deg, views.object_index, views.object_names, views.descriptor)
    np.testing.assert_array_equal(z_of(views), z_of(views, Space(packed)))


def test_a_space_of_some_of_many_views_resembles_that_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    views = catalog(40)
    whole = z_of(views)
    monkeypatch.setattr(space, "_MOST", 400)
    monkeypatch.setattr(space, "MOST_PAIRED", 200)
    assert np.corrcoef(whole.ravel(), z_of(views).ravel())[0, 1] > 0.99


def test_a_view_without_any_feature_has_finite_z() -> None:
    assert not unit_rows(np.zeros((2, 3), np.float32)).any()
    views = catalog(3, kind="edges")
    blank = Views.of_object("blank", np.zeros((2, 512), np.uint8), np.array([0.0, 180.0]), "edges")
    assert np.isfinite(z_of(Views.concatenate([views, blank]))).all()
