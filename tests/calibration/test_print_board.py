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
    stream = zlib.decompress(data[data.index(b"stream\n") + 7 : data.index(b"\nendstream")]).decode("ascii")
    scale = 8.0 / (72 / 25.4)  # 8 pixels a millimetre
    page = np.full((210 * 8, 297 * 8, 3), 255, np.uint8)
    for x, y, w, h in re.findall(r"([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+) re", stream):
        left, low, right, high = (float(v) * scale for v in (x, y, float(x) + float(w), float(y) + float(h)))
        page[round(210 * 8 - high) : round(210 * 8 - low), round(left) : round(right)] = 0
    assert px_per_mm(board, page) == pytest.approx(8.0, rel=1e-3)
    x0, x1 = (float(v) for v in re.search(r"([\d.]+) [\d.]+ m ([\d.]+) [\d.]+ l S", stream).groups())
    assert (x1 - x0) / (72 / 25.4) == pytest.approx(100.0, abs=0.01)


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
