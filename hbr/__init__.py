"""Retrieval: arrays in, decisions out."""

from hbr.active import Decision, Side, next_view
from hbr.cedd import cedd
from hbr.deciding import Rules, Verdict, judge, rehearse, rules
from hbr.dense import Belief, DenseIndex, believe
from hbr.describing import describe
from hbr.descriptors import Descriptor, descriptor
from hbr.familiar import familiar_score
from hbr.frontend import Background, Sighting, sight
from hbr.hough import Extension, Ranking, retrieve
from hbr.index import ViewIndex
from hbr.lead import lead
from hbr.looking import Look, next_look
from hbr.packing import pack, unpack, unpack_rows
from hbr.tanimoto import tanimoto
from hbr.views import Views

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
    "Side",
    "Sighting",
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
    "sight",
    "tanimoto",
    "unpack",
    "unpack_rows",
]
