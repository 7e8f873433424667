import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hbr import pack, unpack, unpack_rows


@given(arrays(np.uint8, 144, elements=st.integers(0, 7)))
def test_unpack_restores_the_packed_levels(levels: np.ndarray) -> None:
    packed = pack(levels)
    assert len(packed) == 54
    assert (unpack(packed) == levels).all()


@given(st.binary(min_size=54, max_size=54))
def test_any_54_bytes_are_a_descriptor(packed: bytes) -> None:
    assert pack(unpack(packed)) == packed


def test_bin_0_and_its_high_bit_are_first() -> None:
    levels = np.zeros(144, np.uint8)
    levels[:3] = 0b100, 0b011, 0b110
    levels[-1] = 0b101
    assert pack([7] * 144) == b"\xff" * 54  # type: ignore[arg-type]
    assert pack(levels) == bytes([0b10001111, 0b00000000]) + bytes(51) + bytes([0b101])


@pytest.mark.parametrize(
    ("levels", "error", "message"),
    [
        (np.full(144, 8), ValueError, "not 0..7"),
        (np.full(144, -1), ValueError, "not 0..7"),
        (np.zeros((1, 144), np.uint8), ValueError, "one descriptor at a time"),
        (np.zeros(143, np.uint8), ValueError, "shape"),
        (np.zeros(144), TypeError, "integer levels"),
    ],
)
def test_invalid_descriptors_are_rejected(levels: np.ndarray, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        pack(levels)


@pytest.mark.parametrize("count", [0, 53, 55])
def test_wrong_number_of_bytes_is_rejected(count: int) -> None:
    with pytest.raises(ValueError, match=f"{count} bytes; cedd has 54"):
        unpack(bytes(count))
    with pytest.raises(ValueError, match="109 bytes are no multiple of 54"):
        unpack_rows(bytes(109))


@given(arrays(np.uint8, st.tuples(st.integers(0, 5), st.just(144)), elements=st.integers(0, 7)))
def test_joined_descriptors_unpack_like_single_ones(levels: np.ndarray) -> None:
    assert np.array_equal(unpack_rows(b"".join(pack(row) for row in levels)), levels)
