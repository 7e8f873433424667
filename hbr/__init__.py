"""Retrieval: arrays in, decisions out."""

from hbr.active import Decision, Side, next_view
from hbr.cedd import cedd, describe
from hbr.familiar import familiar_score
from hbr.hough import Extension, Ranking, retrieve
from hbr.index import ViewIndex
from hbr.lead import lead
from hbr.packing import pack, unpack, unpack_rows
from hbr.tanimoto import tanimoto
from hbr.views import Views

__all__ = [
    "Decision",
    "Extension",
    "Ranking",
    "Side",
    "ViewIndex",
    "Views",
    "cedd",
    "describe",
    "familiar_score",
    "lead",
    "next_view",
    "pack",
    "retrieve",
    "tanimoto",
    "unpack",
    "unpack_rows",
]
