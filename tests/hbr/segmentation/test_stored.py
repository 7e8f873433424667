"""Segmentations that are stored with a view."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hbr
from hbr.descriptors.together import LearnedBackground
from hbr.segmentation.segment import evidence_together, mask_from, mask_text, stored_segmentation
from tests.fuzzing import examples
from tests.hbr.segmentation.test_views_together import frames


@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 40))
@examples(10)
def test_a_silhouette_survives_its_text(seed: int, height: int, width: int) -> None:
    found = np.random.default_rng(seed).random((height, width)) < 0.3
    found[0, 0] = True
    np.testing.assert_array_equal(mask_from(mask_text(found), (height, width)), found)


@given(st.text(max_size=60) | st.binary(max_size=60).map(lambda data: data.hex()) | st.none() | st.integers())
@examples(20)
def test_damaged_text_is_an_error_of_the_value(text: object) -> None:
    with pytest.raises(ValueError, match="silhouette"):
        mask_from(text, (96, 128))  # type: ignore[arg-type]


def test_text_that_expands_to_more_pixels_than_the_image_is_an_error() -> None:
    with pytest.raises(ValueError, match="pixels"):
        mask_from(mask_text(np.ones((4000, 4000), np.bool_)), (96, 128))


@pytest.mark.parametrize("with_picture", [True, False])
def test_a_stored_view_is_segmented_as_it_was_without_the_other_views(with_picture: bool) -> None:
    images, empty, _ = frames(3)
    table = empty if with_picture else None
    learned = LearnedBackground()
    for image in images:
        learned.add(image)
    (found,) = hbr.hypotheses(images[1], empty_table=table, learned=learned.of(1), most=1)
    evidence = evidence_together(found, 3)
    again = stored_segmentation(images[1], evidence, empty_table=table)
    np.testing.assert_array_equal(again.crop, found.crop)
    np.testing.assert_array_equal(again.mask, found.mask)
    assert evidence_together(again, 3) == evidence
    alone = stored_segmentation(images[1], hbr.segment(images[1], empty_table=table).evidence(), empty_table=table)
    assert alone.box == hbr.segment(images[1], empty_table=table).box
