"""The background that is learned from the views of one search or enrollment."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from hbr.segmentation.background import median


@given(st.data(), st.integers(1, 10), array_shapes(min_dims=2, max_dims=3, max_side=4))
def test_median_is_that_of_numpy_rounded_down(data: st.DataObject, count: int, shape: tuple[int, ...]) -> None:
    images = data.draw(arrays(np.uint8, (count, *shape)))
    before = images.copy()
    np.testing.assert_array_equal(median(list(images)), np.median(images, axis=0).astype(np.uint8))
    np.testing.assert_array_equal(images, before)
