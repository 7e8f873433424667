"""Print the calibration board true to scale, as a PDF."""

import zlib
from pathlib import Path
from typing import Final

import numpy as np

from rig.core.errors import UsageError, os_errors_as
from rig.core.files import write
from rig.views.charuco_board import CharucoBoard

CELLS: Final = 6 * 15  # a marker has six bits on a side with its border, and is 11/15 of a square: whole cells
"""Pixels along the side of a square."""
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


def _pdf(board: CharucoBoard) -> bytes:
    """Return one A4 page in landscape, with the board in its middle and a ruler of 100 mm below it."""
    width_px, height_px = board.columns * CELLS, board.rows * CELLS
    picture = board.layout().generateImage((width_px, height_px), marginSize=0, borderBits=1)
    left = (PAGE_MM[0] - board.size_mm[0]) / 2
    bottom = (PAGE_MM[1] - board.size_mm[1]) / 2 + 5
    # A ruler below the board shows whether the printer scaled the page.
    ruler_x, ruler_y = (PAGE_MM[0] - RULER_MM) / 2, bottom - board.margin_mm - 6
    words = (
        f"{board.columns} x {board.rows}, squares {board.square_mm:g} mm; this line is {RULER_MM:g} mm: print at 100 %"
    )
    # All lengths below are millimetres: the first operator scales them.
    drawn = (
        f"{POINTS_MM:.6f} 0 0 {POINTS_MM:.6f} 0 0 cm\n"
        f"q {board.size_mm[0]:.4f} 0 0 {board.size_mm[1]:.4f} {left:.4f} {bottom:.4f} cm /Board Do Q\n"
        f"0.3 w {ruler_x:.4f} {ruler_y:.4f} m {ruler_x + RULER_MM:.4f} {ruler_y:.4f} l S\n"
        f"BT /F1 3.2 Tf {ruler_x:.4f} {ruler_y - 5:.4f} Td ({words}) Tj ET"
    )
    image = f"/Type /XObject /Subtype /Image /Width {width_px} /Height {height_px} /ColorSpace /DeviceGray"
    # The file: six objects, a table of their places, and the trailer.
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {PAGE_MM[0] * POINTS_MM:.4f} {PAGE_MM[1] * POINTS_MM:.4f}] "
        "/Contents 4 0 R /Resources << /Font << /F1 5 0 R >> /XObject << /Board 6 0 R >> >> >>".encode("ascii"),
        _stream("", drawn.encode("ascii")),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
        _stream(f"{image} /BitsPerComponent 1", np.packbits(np.asarray(picture) >= 128, axis=1).tobytes()),
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


def _stream(keys: str, content: bytes) -> bytes:
    packed = zlib.compress(content)
    head = f"<< {keys} /Length {len(packed)} /Filter /FlateDecode >>\nstream\n"
    return head.encode("ascii") + packed + b"\nendstream"
