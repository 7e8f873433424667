"""Retrieval: arrays in, decisions out."""

from hbr.dense.filter import Belief, DenseIndex, believe
from hbr.dense.next_view import Look, next_look
from hbr.dense.stopping import Rules, Verdict, judge, rehearse, rules
from hbr.descriptors import Descriptor, descriptor
from hbr.descriptors.cedd import cedd
from hbr.descriptors.cedd_packing import pack, unpack, unpack_rows
from hbr.descriptors.describe import describe
from hbr.descriptors.tanimoto import tanimoto
from hbr.model.views import Views
from hbr.paper.hough import Extension, Ranking, retrieve
from hbr.paper.index import ViewIndex
from hbr.paper.margin import lead
from hbr.paper.next_view import Decision, Side, next_view
from hbr.paper.open_set import familiar_score
from hbr.segmentation import Background, Segmentation, segment

__all__ = [
    "Background",
    "Belief",
    "Decision",
    "DenseIndex",
    "Descriptor",
    "Extension",
    "Look",
    "Ranking",
    "Rules",
    "Segmentation",
    "Side",
    "Verdict",
    "ViewIndex",
    "Views",
    "believe",
    "cedd",
    "describe",
    "descriptor",
    "familiar_score",
    "judge",
    "lead",
    "next_look",
    "next_view",
    "pack",
    "rehearse",
    "retrieve",
    "rules",
    "segment",
    "tanimoto",
    "unpack",
    "unpack_rows",
]
