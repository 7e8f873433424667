"""Segmentation: finds the object in a frame, corrects its illumination, and brings it to a fixed size."""

from hbr.segmentation.background import MIN_AGREEMENT, Background, BoxMethod, Issue, IssueCode
from hbr.segmentation.cut_out import CROP_PX, Segmentation
from hbr.segmentation.segment import hypotheses, segment

__all__ = [
    "CROP_PX",
    "MIN_AGREEMENT",
    "Background",
    "BoxMethod",
    "Issue",
    "IssueCode",
    "Segmentation",
    "hypotheses",
    "segment",
]
