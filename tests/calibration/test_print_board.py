"""The printed board is true to scale, and the camera finds it."""

import re
import shutil
import subprocess
import zlib

import cv2
import numpy as np
import pytest

from calibration.print_board import write_board
from rig.core.errors import UsageError
from rig.views.charuco_board import CharucoBoard, detect_board


def px_per_mm(board: CharucoBoard, picture) -> float:
    found = detect_board(board, picture)
    assert found.ids.size == board.corners
    flat = np.column_stack([board.points_mm()[found.ids][:, :2], np.ones(found.ids.size)])
    map_, residual, *_ = np.linalg.lstsq(flat, found.corners_px, rcond=None)
    assert np.sqrt(residual.sum() / found.ids.size) < 0.5
    return float(np.linalg.norm(map_[0]))


def test_pdf_is_true_to_scale(tmp_path):
    """By the page's own operators: PDF readers need not be installed."""
    board = CharucoBoard(columns=6, rows=5, square_mm=20.0, marker_mm=20.0 * 11 / 15)
    assert "6 squares must be 120 mm" in write_board(board, tmp_path / "board.pdf")
    data = (tmp_path / "board.pdf").read_bytes()
    drawn, pixels = (zlib.decompress(part.split(b"\nendstream")[0]) for part in data.split(b"stream\n")[1::2])
    assert float(drawn.split()[0]) == pytest.approx(72 / 25.4)
    width_mm, height_mm = map(float, re.search(rb"q (\S+) 0 0 (\S+) ", drawn).groups())
    width, height = (int(re.search(rb"/%s (\d+)" % key, data).group(1)) for key in (b"Width", b"Height"))
    assert (width / width_mm, height / height_mm) == pytest.approx((4.5, 4.5))
    rows = np.unpackbits(np.frombuffer(pixels, np.uint8).reshape(height, -1), axis=1)[:, :width]
    picture = cv2.copyMakeBorder(rows * np.uint8(255), 20, 20, 20, 20, cv2.BORDER_CONSTANT, value=255)
    assert px_per_mm(board, cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)) == pytest.approx(4.5, rel=1e-3)
    x0, x1 = map(float, re.search(rb"(\S+) \S+ m (\S+) \S+ l S", drawn).groups())
    assert x1 - x0 == pytest.approx(100.0)


@pytest.mark.skipif(shutil.which("pdftoppm") is None, reason="pdftoppm (Debian: poppler-utils) is not installed")
def test_pdf_reader_draws_the_board(tmp_path):
    write_board(CharucoBoard(), tmp_path / "board.pdf")
    subprocess.run(["pdftoppm", "-r", "150", "-png", tmp_path / "board.pdf", tmp_path / "page"], check=True)
    (page,) = tmp_path.glob("page*.png")
    assert px_per_mm(CharucoBoard(), cv2.imread(str(page))) == pytest.approx(150 / 25.4, rel=1e-3)


def test_unprintable_boards_are_rejected(tmp_path):
    with pytest.raises(UsageError, match=r"is no \.pdf"):
        write_board(CharucoBoard(), tmp_path / "board.jpg")
    with pytest.raises(UsageError, match="does not fit"):
        write_board(CharucoBoard(square_mm=40.0, marker_mm=29.0), tmp_path / "board.pdf")
    with pytest.raises(UsageError, match="Cannot write"):
        write_board(CharucoBoard(), tmp_path / "nowhere" / "board.pdf")
