"""Retrieval: arrays in, decisions out."""

from hbr.dense.filter import Belief, DenseIndex, update_belief
from hbr.dense.next_view import NextBestView, next_best_view
from hbr.dense.stopping import Rules, Verdict, judge, rehearse, rules
from hbr.descriptors import Descriptor, descriptor
from hbr.descriptors.cedd import cedd
from hbr.descriptors.cedd_packing import pack, unpack, unpack_rows
from hbr.descriptors.describe import describe
from hbr.descriptors.tanimoto import tanimoto
from hbr.model.views import Views
from hbr.paper.hough import Extension, Ranking, retrieve
from hbr.paper.index import ViewIndex
from hbr.paper.margin import score_margin
from hbr.paper.next_view import Decision, Side, next_view
from hbr.paper.open_set import open_set_threshold
from hbr.segmentation import Background, Segmentation, segment

__all__ = [
    "Background",
    "Belief",
    "Decision",
    "DenseIndex",
    "Descriptor",
    "Extension",
    "NextBestView",
    "Ranking",
    "Rules",
    "Segmentation",
    "Side",
    "Verdict",
    "ViewIndex",
    "Views",
    "cedd",
    "describe",
    "descriptor",
    "judge",
    "next_best_view",
    "next_view",
    "open_set_threshold",
    "pack",
    "rehearse",
    "retrieve",
    "rules",
    "score_margin",
    "segment",
    "tanimoto",
    "unpack",
    "unpack_rows",
    "update_belief",
]
