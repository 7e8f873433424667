"""Emitted events agree with the tables of their documentation, and are read again as they were."""

import re
from dataclasses import fields, is_dataclass
from typing import Any, get_args

import pytest

import hbr
from docs.generate import CODES, events_page
from hbr import StopDecision
from hbr.dense import stopping
from hbr.model.symmetry import SimilarObject
from rig.catalog import Catalog, derived
from rig.core.errors import Problem, ViewRejected
from rig.core.next_steps import NextStep
from rig.devices.camera import CameraLocks
from rig.events.events import (
    SCHEMA,
    Candidate,
    Event,
    Failed,
    FrameUsed,
    LeftOut,
    Note,
    NoteCode,
    ObjectChanged,
    Ranked,
    RotationReason,
    ScanStarted,
    Unwinding,
    Verified,
    Waiting,
    WaitReason,
    Warned,
    Weighed,
    event_dict,
    event_of,
)
from rig.motion.scan_speed import SpeedLimit
from rig.plans.enroll import enroll, similar_objects
from rig.plans.identify import ResultRecorder, identify
from rig.plans.photograph_table import photograph_table
from rig.plans.tray import TrayItem, enroll_tray
from rig.safety.gyro_rotation import Stillness
from rig.search.model import load_model, model_of
from rig.views.capture import MotionEvidence, ViewEvidence

TEXT = events_page()
KINDS = {next(f.default for f in fields(kind) if f.name == "event"): kind for kind in get_args(Event)}
NOT_IN_TABLES = {"event", "image_bgr"}
PLAIN = {"string": str, "integer": int, "number": (int, float), "boolean": bool, "object": dict}
PARTS = {
    "candidate": Candidate,
    "similar_object": SimilarObject,
    "weighed": Weighed,
    "left_out": LeftOut,
    "note": Note,
    "stop_decision": StopDecision,
    "view_evidence": ViewEvidence,
    "camera_locks": CameraLocks,
    "stillness": Stillness,
    "motion_evidence": MotionEvidence,
    "problem": Problem,
    "next_step": NextStep,
}


def documented() -> dict[str, dict[str, str]]:
    """Return the types of the fields, by section and field."""
    tables: dict[str, dict[str, str]] = {}
    for section in re.split(r"^##+ ", TEXT, flags=re.MULTILINE)[1:]:
        rows = re.findall(r"^\| `(\w+)` \| ([^|]+) \| [^|]+ \|$", section, re.MULTILINE)
        if rows:
            tables[section.split("\n")[0].strip()] = dict(rows)
    return tables


SCHEMAS = documented()


def check(value: Any, kind: str, where: str) -> None:
    if kind.endswith(" or null"):
        if value is None:
            return
        kind = kind.removesuffix(" or null")
    if kind.startswith("list of "):
        assert isinstance(value, list), where
        for item in value:
            check(item, kind.removeprefix("list of "), where)
    elif " or " in kind:
        first, _, other = kind.partition(" or ")
        check(value, first if isinstance(value, PLAIN[first]) else other, where)
    elif kind in PLAIN:
        assert isinstance(value, PLAIN[kind]), f"{where}: {value!r} is no {kind}"
        assert (kind == "boolean") == isinstance(value, bool), f"{where}: {value!r} is no {kind}"
    else:
        check_fields(value, kind, where)


def check_fields(value: dict[str, Any], kind: str, where: str) -> None:
    assert value.keys() == SCHEMAS[kind].keys(), where
    for name, item in value.items():
        check(item, SCHEMAS[kind][name], f"{where}.{name}")


def check_event(event: Event) -> str:
    """Compare an event with the document, read it again, and return its kind."""
    assert event_dict(event_of(event_dict(event))) == event_dict(event)
    return check_values(event_dict(event))


def check_values(reported: dict[str, Any]) -> str:
    kind = str(reported["event"])
    check_fields({name: value for name, value in reported.items() if name != "event"}, kind, kind)
    return kind


def test_every_event_and_part_is_documented_with_exactly_its_fields():
    assert SCHEMAS.keys() == KINDS.keys() | PARTS.keys()
    for name, kind in (KINDS | PARTS).items():
        assert is_dataclass(kind)
        assert [f.name for f in fields(kind) if f.name not in NOT_IN_TABLES] == list(SCHEMAS[name]), name
    assert f"# Events, schema {SCHEMA}" in TEXT


def test_every_code_of_a_reason_or_note_has_its_meaning():
    kinds = {kind.__name__: kind for kind in (RotationReason, hbr.StopReason, NoteCode)}
    for name, heading in CODES.items():
        (section,) = re.findall(rf"^### {heading.replace('-', ' ').capitalize()}\n(.*?)(?=^#|\Z)", TEXT, re.M | re.S)
        assert set(re.findall(r"^\| `([\w-]+)` \| [^|]+ \|$", section, re.M)) == {str(code) for code in kinds[name]}


def test_every_event_that_the_plans_emit_is_as_documented(simulated, tmp_path, monkeypatch):
    s = simulated("table.limits_deg=[-180, 185]", "identify.max_views=5", "identify.margin=1", seed=2)
    seen = set()
    with Catalog.open(tmp_path, clock=s.bench.clock) as catalog:
        for event in enroll(s.bench, catalog, "dice", views=6):
            seen.add(check_event(event))
        for event in photograph_table(s.bench):
            seen.add(check_event(event))
        items = [TrayItem(2, "dice"), TrayItem(3, "lamp", label="light")]
        for event in enroll_tray(s.bench, catalog, items, views=4):
            seen.add(check_event(event))
        views = derived.views(catalog)
        seen |= {check_event(similar_objects(views, name)) for name in ("dice", "lamp")}
        recorder = ResultRecorder(tmp_path, s.bench, clock=s.bench.clock, catalog_version=catalog.version)
        for event in identify(s.bench, model_of(views), strategy="sweep"):
            seen.add(check_event(event))
            if recorded := recorder.add(event):
                seen.add(check_event(recorded))
        monkeypatch.setattr(stopping, "HOPELESS", 1.0)  # the search for an object that is not enrolled takes all views
        s.operator.next_object = "radio"
        reported = [event_dict(event) for event in identify(s.bench, load_model(catalog))]
        assert {"decided", "identified"} <= {check_values(values) for values in reported}
        assert any(values["weighed"] for values in reported if values["event"] == "decided")
        s.world.change(light=(0.0, 0.0, 0.0))
        with pytest.raises(ViewRejected) as caught:
            for event in enroll(s.bench, catalog, "candle", views=4):
                seen.add(check_event(event))
    seen |= {check_event(Failed(caught.value.problem)), check_event(Waiting(WaitReason.NEXT_OBJECT))}
    seen.add(check_event(Warned(3, Note(NoteCode.EMPTY_TABLE_CHANGED, {"problem": {"code": "missing"}}))))
    seen.add(check_event(FrameUsed(3, 30.0, 1.0, 0, "dice", 0.5, hbr.Outcome.CONTINUE)))
    seen.add(check_event(ScanStarted(90.0, SpeedLimit.SMEAR, 10.0, 0.0, 360.0)))
    decision = StopDecision(hbr.Outcome.FOUND, hbr.StopReason.CONFIDENT, 0, 0.99, 0.004, 0.97)
    seen.add(check_event(Ranked(3, (Candidate("dice", 0.9, 30.0, 0.99),), 0.2, decision)))
    seen.add(check_event(ObjectChanged(3, 2, 7.5, 3.0)))
    seen.add(check_event(Verified(3, "dice", 0.7, 0.4, 0.3, 0.8, 0.02, hbr.Outcome.FOUND, 0.99, 0.004)))
    seen.add(check_event(Unwinding(0, 330.0, 0.0, 1, (-400.0, 400.0))))
    assert seen == KINDS.keys()
