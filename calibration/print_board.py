"""Print the calibration board true to scale, as a PDF of vector squares."""

import zlib
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rig.core.errors import UsageError, os_errors_as
from rig.core.files import write
from rig.views.charuco_board import CharucoBoard

POINTS_MM: Final = 72 / 25.4  # PDF's unit is 1/72 inch; the page is A4, landscape
PAGE_MM: Final = (297.0, 210.0)
RULER_MM: Final = 100.0


def write_board(board: CharucoBoard, path: Path) -> str:
    """Write the board to a file, and return instructions for the operator.

    Raises `UsageError` if the file is no .pdf, the board is larger than the page, or the file cannot be written.
    """
    width, height = (side + 2 * board.margin_mm for side in board.size_mm)
    if path.suffix.lower() != ".pdf":
        raise UsageError(f"{path.name} is no .pdf.", next_step="Give a file name that ends in .pdf.")
    if width > PAGE_MM[0] or height + 15 > PAGE_MM[1]:
        raise UsageError(
            f"A board of {width:.0f} x {height:.0f} mm does not fit a page of {PAGE_MM[0]:g} x {PAGE_MM[1]:g} mm.",
            next_step="Give fewer columns and rows, or smaller squares.",
        )
    step = "Give a file in an existing folder that you may write to."
    with os_errors_as(UsageError, f"Cannot write {path}.", next_step=step):
        write(path, _pdf(board))
    return (
        f"{path}: {board.columns} x {board.rows} squares of {board.square_mm:g} mm. Print it at 100 % (not fitted to "
        f"the page), glue it to something stiff and flat, and measure: {board.columns} squares must be "
        f"{board.size_mm[0]:g} mm. If not, measure one square and give --square-mm: the camera cannot see the scale."
    )


def _modules(board: CharucoBoard) -> tuple[NDArray[np.bool_], float]:
    """Return the black cells of the finest grid of the print, bool (rows, columns), and the side of a cell in mm.

    The grid is fine enough for the squares and for the bits of the markers (six per side, with the border).
    """
    cells = 6 * 15
    picture = board.layout().generateImage((board.columns * cells, board.rows * cells), marginSize=0, borderBits=1)
    return np.asarray(picture) < 128, board.square_mm / cells


def _rectangles(black: NDArray[np.bool_]) -> list[tuple[int, int, int, int]]:
    """Return disjoint rectangles (column, row, width, height) that cover the black cells, merged over equal rows."""
    found: list[tuple[int, int, int, int]] = []
    open_runs: dict[tuple[int, int], int] = {}
    padded = np.pad(black, ((0, 1), (1, 1))).astype(np.int8)
    for row, cells in enumerate(padded):
        edges = np.flatnonzero(np.diff(cells))
        runs = {(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)}
        for run in [run for run in open_runs if run not in runs]:
            start = open_runs.pop(run)
            found.append((run[0], start, run[1] - run[0], row - start))
        for run in runs:
            open_runs.setdefault(run, row)
    return found


def _pdf(board: CharucoBoard) -> bytes:
    """Return one A4 page in landscape, with the board in its middle and a ruler of 100 mm below it."""
    black, cell_mm = _modules(board)
    left = (PAGE_MM[0] - board.size_mm[0]) / 2
    top = (PAGE_MM[1] + board.size_mm[1]) / 2 + 5
    drawn = [
        f"{(left + x * cell_mm) * POINTS_MM:.4f} {(top - (y + h) * cell_mm) * POINTS_MM:.4f} "
        f"{w * cell_mm * POINTS_MM:.4f} {h * cell_mm * POINTS_MM:.4f} re"
        for x, y, w, h in _rectangles(black)
    ]
    # A ruler below the board shows whether the printer scaled the page.
    ruler_y = top - board.size_mm[1] - board.margin_mm - 6
    ruler_x = (PAGE_MM[0] - RULER_MM) / 2
    words = (
        f"{board.columns} x {board.rows}, squares {board.square_mm:g} mm; this line is {RULER_MM:g} mm: print at 100 %"
    )
    stream = "\n".join(
        [
            "0 g",
            *drawn,
            "f",
            f"{0.3 * POINTS_MM:.3f} w",
            f"{ruler_x * POINTS_MM:.4f} {ruler_y * POINTS_MM:.4f} m "
            f"{(ruler_x + RULER_MM) * POINTS_MM:.4f} {ruler_y * POINTS_MM:.4f} l S",
            f"BT /F1 9 Tf {ruler_x * POINTS_MM:.4f} {(ruler_y - 5) * POINTS_MM:.4f} Td ({words}) Tj ET",
        ]
    ).encode("ascii")
    # The file: five objects, a table of their places, and the trailer.
    packed = zlib.compress(stream)
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {PAGE_MM[0] * POINTS_MM:.4f} {PAGE_MM[1] * POINTS_MM:.4f}] "
        "/Contents 4 0 R /Resources << /Font << /F1 5 0 R >> >> >>".encode("ascii"),
        f"<< /Length {len(packed)} /Filter /FlateDecode >>\nstream\n".encode("ascii") + packed + b"\nendstream",
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    out = b"%PDF-1.4\n"
    places = []
    for number, body in enumerate(objects, start=1):
        places.append(len(out))
        out += b"%d 0 obj\n" % number + body + b"\nendobj\n"
    table = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    out += b"".join(b"%010d 00000 n \n" % place for place in places)
    return out + b"trailer << /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, table)
