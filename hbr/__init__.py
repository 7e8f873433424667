"""Retrieval: arrays in, decisions out."""

from hbr.dense.filter import Belief, update_belief
from hbr.dense.index import DenseIndex
from hbr.dense.next_view import NextBestView, next_best_view
from hbr.dense.session import DenseSession
from hbr.dense.stopping import Outcome, StopDecision, StopReason
from hbr.descriptors import Descriptor, descriptor
from hbr.descriptors.cedd import cedd, pack, unpack, unpack_rows
from hbr.descriptors.registry import describe
from hbr.descriptors.similarity import tanimoto
from hbr.descriptors.together import ViewsTogether
from hbr.model.views import PackedViews, Views
from hbr.paper.hough import Extension, Ranking, retrieve
from hbr.paper.index import ViewIndex
from hbr.paper.next_view import Decision, Side, next_view
from hbr.paper.open_set import open_set_threshold, score_margin
from hbr.segmentation import Background, Segmentation, hypotheses, segment

__all__ = [
    "Background",
    "Belief",
    "Decision",
    "DenseIndex",
    "DenseSession",
    "Descriptor",
    "Extension",
    "NextBestView",
    "Outcome",
    "PackedViews",
    "Ranking",
    "Segmentation",
    "Side",
    "StopDecision",
    "StopReason",
    "ViewIndex",
    "Views",
    "ViewsTogether",
    "cedd",
    "describe",
    "descriptor",
    "hypotheses",
    "next_best_view",
    "next_view",
    "open_set_threshold",
    "pack",
    "retrieve",
    "score_margin",
    "segment",
    "tanimoto",
    "unpack",
    "unpack_rows",
    "update_belief",
]
