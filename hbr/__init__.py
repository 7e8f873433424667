"""Retrieval: arrays in, decisions out."""

from hbr.active import Decision, Side, next_view
from hbr.cedd import cedd
from hbr.describing import describe
from hbr.descriptors import Descriptor, descriptor
from hbr.familiar import familiar_score
from hbr.frontend import Background, Sighting, sight
from hbr.hough import Extension, Ranking, retrieve
from hbr.index import ViewIndex
from hbr.lead import lead
from hbr.packing import pack, unpack, unpack_rows
from hbr.tanimoto import tanimoto
from hbr.views import Views

__all__ = [
    "Background",
    "Decision",
    "Descriptor",
    "Extension",
    "Ranking",
    "Side",
    "Sighting",
    "ViewIndex",
    "Views",
    "cedd",
    "describe",
    "descriptor",
    "familiar_score",
    "lead",
    "next_view",
    "pack",
    "retrieve",
    "sight",
    "tanimoto",
    "unpack",
    "unpack_rows",
]
