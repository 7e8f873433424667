"""Retrieval: arrays in, decisions out."""

from typing import Any
from warnings import warn

from hbr.dense.calibration import CalibratedRule, calibrate_stopping_rule, fit_stopping_rule
from hbr.dense.filter import Belief, update_belief
from hbr.dense.index import DenseIndex
from hbr.dense.leave_one_out import LeaveOneOut, leave_one_out
from hbr.dense.next_view import NextBestView, next_best_view
from hbr.dense.session import DenseSession
from hbr.dense.stopping import Outcome, StopDecision, StoppingRule, StopReason
from hbr.descriptors import Descriptor, descriptor
from hbr.descriptors.cedd import cedd
from hbr.descriptors.cedd_packing import pack, unpack, unpack_rows
from hbr.descriptors.describe import describe
from hbr.descriptors.tanimoto import tanimoto
from hbr.descriptors.together import ViewsTogether
from hbr.model.views import PackedViews, Views
from hbr.paper.hough import Extension, Ranking, retrieve
from hbr.paper.index import ViewIndex
from hbr.paper.margin import score_margin
from hbr.paper.next_view import Decision, Side, next_view
from hbr.paper.open_set import open_set_threshold
from hbr.segmentation import Background, Segmentation, hypotheses, segment

__all__ = [
    "Background",
    "Belief",
    "CalibratedRule",
    "Decision",
    "DenseIndex",
    "DenseSession",
    "Descriptor",
    "Extension",
    "LeaveOneOut",
    "NextBestView",
    "Outcome",
    "PackedViews",
    "Ranking",
    "Segmentation",
    "Side",
    "StopDecision",
    "StopReason",
    "StoppingRule",
    "ViewIndex",
    "Views",
    "ViewsTogether",
    "calibrate_stopping_rule",
    "cedd",
    "describe",
    "descriptor",
    "fit_stopping_rule",
    "hypotheses",
    "leave_one_out",
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

#: Names of version 0.1 and what replaces them; they go with version 0.3.
_RENAMED = {
    "Look": "NextBestView",
    "Rules": "StoppingRule",
    "Sighting": "Segmentation",
    "Verdict": "StopDecision",
    "believe": "update_belief",
    "familiar_score": "open_set_threshold",
    "judge": "StoppingRule.decide",
    "lead": "score_margin",
    "next_look": "next_best_view",
    "rehearse": "leave_one_out",
    "rules": "fit_stopping_rule",
    "sight": "segment",
}


def __getattr__(name: str) -> Any:
    """Return what replaces a name of version 0.1, with a `DeprecationWarning`."""
    if name not in _RENAMED:
        raise AttributeError(f"module 'hbr' has no attribute {name!r}")
    new = _RENAMED[name]
    warn(f"hbr.{name} is now hbr.{new}; the old name goes with version 0.3", DeprecationWarning, stacklevel=2)
    if name == "judge":
        return lambda belief, by, **options: by.decide(belief, **options)
    return globals()[new]
