"""Saved runs of formats 1 and 2: their events under today's names. Their sentences stay as they are, as notes."""

from collections.abc import Callable
from typing import Any, Final

from hbr import Outcome, StopReason
from rig.events.events import Decided, Identified, NoteCode, Ranked, RotationReason
from rig.views.segmentation_evidence import upgrade_evidence

NOT_SAVED: Final[dict[type, tuple[str, ...]]] = {
    Ranked: ("decision",),
    Decided: ("reason", "note"),
    Identified: (
        "outcome",
        "possible",
        "yaw_deg",
        "yaw_sigma_deg",
        "yaw_set_deg",
        "period_deg",
        "reason",
        "note",
        "min_score",
        "min_margin",
        "min_confidence",
        "open_set_threshold",
    ),
}
"""Fields of events that formats 1 and 2 do not have, or only in words."""

_KINDS: Final = {"insight": "similar_objects", "tablepicture": "empty_table_image"}


def upgraded(event: dict[str, Any]) -> dict[str, Any]:
    """Return an event of format 1 or 2, as JSON values, in format 3."""
    kind = _KINDS.get(event["event"], event["event"])
    return {**_FIELDS.get(kind, dict)(event), "event": kind}


def _started(event: dict[str, Any]) -> dict[str, Any]:
    return event | {"notes": [_note(text) for text in event.get("notes", ())]}


def _accepted(event: dict[str, Any]) -> dict[str, Any]:
    evidence = event.get("front_end")
    return event | {"segmentation": evidence and upgrade_evidence(evidence)}


def _unwinding(event: dict[str, Any]) -> dict[str, Any]:
    return event | {"revolutions": event["turns"]}


def _decided(event: dict[str, Any]) -> dict[str, Any]:
    weighed = event.get("weighed")
    return event | {
        "candidates": event["rivals"],
        "reason": RotationReason.EARLIER_VERSION,
        "note": event.get("why", ""),
        "weighed": weighed and weighed | {"similarity": weighed["alike"]},
    }


def _warned(event: dict[str, Any]) -> dict[str, Any]:
    return event | {"note": _note(event["what"], next_step=event["next_step"])}


def _identified(event: dict[str, Any]) -> dict[str, Any]:
    names = [one["name"] for one in event["candidates"]]
    outcome, possible = Outcome.FOUND, names[:1]
    if event["name"] is None:
        outcome, possible = Outcome.UNKNOWN, []
    elif event["margin"] <= 0 and len(names) > 1:  # these versions reported it as "Not sure"
        outcome, possible = Outcome.AMBIGUOUS, names[:2]
    return event | {
        "outcome": outcome,
        "possible": possible,
        "yaw_set_deg": [event["yaw_deg"]],
        "reason": StopReason.EARLIER_VERSION,
        "note": event["reason"],
        "confidence": event.get("probability") if outcome is Outcome.FOUND else None,
        "open_set_score": event.get("familiarity"),
        "open_set_threshold": event.get("min_familiarity"),
    }


def _note(text: str, **values: str) -> dict[str, Any]:
    return {"code": NoteCode.EARLIER_VERSION, "values": {"text": text, **values}}


_FIELDS: Final[dict[str, Callable[[dict[str, Any]], dict[str, Any]]]] = {
    "started": _started,
    "accepted": _accepted,
    "unwinding": _unwinding,
    "decided": _decided,
    "warned": _warned,
    "identified": _identified,
}
