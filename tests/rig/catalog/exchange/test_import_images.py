"""Images that are damaged or too large are rejected before they are decoded."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.views import image_files as images
from tests.fuzzing import examples
from tests.rig.catalog.catalog_samples import (
    image,
)
from tests.rig.catalog.exchange.exchange_samples import png_of


class TestImages:
    @pytest.mark.parametrize(
        ("content", "reason"),
        [
            (png_of(50_000, 50_000), "50000 x 50000 pixels"),
            (png_of(30_000, 2), "30000 x 2 pixels"),
            (png_of(0, 5), "0 x 5 pixels"),
            (png_of(2**31, 2**31), "pixels"),
            (b"GIF89a" + bytes(100), "neither a PNG nor a JPEG"),
            (b"", "neither a PNG nor a JPEG"),
            (b"\x89PNG\r\n\x1a\n", "truncated"),
            (b"\xff\xd8\xff\xe0\x00\x00" * 9 + b"\xff\xd9", "truncated"),
        ],
    )
    def test_invalid_images_are_rejected(self, content: bytes, reason: str) -> None:
        with pytest.raises(images.BadImage, match=reason):
            images.decode(content)

    @examples(52)
    @given(st.binary(max_size=64), st.sampled_from([b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"]))
    def test_arbitrary_bytes_are_rejected(self, content: bytes, head: bytes) -> None:
        with pytest.raises(images.BadImage):
            images.decode(head + content)

    @examples(26)
    @given(st.data())
    def test_damaged_image_is_decoded_or_rejected(self, data: st.DataObject) -> None:
        suffix = data.draw(st.sampled_from([".png", ".jpg"]))
        content = bytearray(cv2.imencode(suffix, image(1))[1].tobytes())
        for _ in range(data.draw(st.integers(1, 4))):
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
        try:
            found = images.decode(bytes(content))
        except images.BadImage:
            return
        assert found.dtype == np.uint8
        assert found.ndim == 3

    def test_size_of_jpeg_is_read(self) -> None:
        for progressive in (0, 1):
            content = cv2.imencode(".jpg", image(1), [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])[1].tobytes()
            assert images.decode(content).shape == image(1).shape
