"""Notes of a plan, and limitations of a stopping rule, in words."""

from typing import Any

from hbr.dense.stopping import Limitation, LimitationCode
from rig.core.next_steps import Do, NextSteps, steps_from_json
from rig.core.phrases import counted, joined, percent
from rig.events.events import Note, NoteCode, WaitReason
from rig.views.table_problems import problem_text


def note_words(note: Note) -> str:
    """Return a note as a sentence without its full stop."""
    v = note.values
    match note.code:
        case NoteCode.MIXED_EMPTY_TABLE:
            names, one = v["objects"], len(v["objects"]) == 1
            return (
                f"{_some(names)} {'was' if one else 'were'} enrolled {'with' if v['with_image'] else 'without'} an "
                "empty-table image, unlike the other objects, and such views compare badly"
            )
        case NoteCode.ENROLLED_WITHOUT_EMPTY_TABLE:
            return "most objects were enrolled without an empty-table image, so the search does not use it"
        case NoteCode.EMPTY_TABLE_DOUBTED:
            return f"the empty-table image may be outdated ({_problems(v)})"
        case NoteCode.EMPTY_TABLE_MISSING:
            return f"the search has no empty-table image ({_problems(v)})"
        case NoteCode.EMPTY_TABLE_OF_ENROLLMENT:
            return f"the empty-table image of the enrollment is used ({_problems(v)})"
        case NoteCode.EMPTY_TABLE_CHANGED:
            return f"the bench no longer looks like its empty-table image: {problem_text(v['problem'])}"
        case NoteCode.TABLE_DIFFERS:
            return f"the table does not look as it did at {v['taken_utc']}; an object that is round may be on it"
        case NoteCode.STOPPING_RULE_UNREADABLE:
            return f"the stored stopping rule cannot be read ({v['reason']})"
        case NoteCode.STOPPING_RULE_OUTDATED:
            changes = [f"{counted(v[key], 'object')} {key}" for key in ("added", "removed") if v[key]]
            changed = ", ".join(changes) or "other views, or another version of this program"
            return (
                f"the stopping rule is from {v['made']}, and the catalog has changed since ({changed}), so it "
                "guarantees no error rate"
            )
        case NoteCode.RATES_NOT_GUARANTEED:
            accepted = f" and {percent(v['false_accept'])} of other objects accepted" if "false_accept" in v else ""
            return (
                f"{v['searches']} leave-one-out searches cannot guarantee at most {percent(v['error_rate'])} wrong "
                f"answers and {percent(v['false_reject'])} of the enrolled objects called unknown{accepted}"
            )
        case NoteCode.NOT_RECORDED:
            return f"the answer is not recorded: {v['what'].rstrip('.')}"
        case NoteCode.NOT_COMPARED:
            return f"the leading candidates are not compared pixel by pixel: {v['what'].rstrip('.')}"
        case NoteCode.LOCAL_COPY:
            return f"the server of the catalog cannot be used; this uses the copy of {v['copied_utc']}"


def _problems(values: dict[str, Any]) -> str:
    return "; ".join(problem_text(problem) for problem in values["problems"])


def note_steps(note: Note) -> NextSteps:
    """Return what the operator should do about a note; empty if nothing."""
    match note.code:
        case NoteCode.MIXED_EMPTY_TABLE | NoteCode.ENROLLED_WITHOUT_EMPTY_TABLE:
            return (Do.ENROLL_AGAIN(),)
        case NoteCode.EMPTY_TABLE_DOUBTED | NoteCode.EMPTY_TABLE_MISSING | NoteCode.EMPTY_TABLE_OF_ENROLLMENT:
            return (Do.EMPTY_TABLE(),)
        case NoteCode.EMPTY_TABLE_CHANGED:
            return ("Continue; these views do not use the image.", Do.EMPTY_TABLE())
        case NoteCode.TABLE_DIFFERS:
            return ("Check that the table is empty. If it is not, remove the object, and", Do.EMPTY_TABLE())
        case NoteCode.STOPPING_RULE_UNREADABLE | NoteCode.STOPPING_RULE_OUTDATED | NoteCode.RATES_NOT_GUARANTEED:
            return (Do.FIT_STOPPING_RULE(),)
        case _:
            return steps_from_json(note.values.get("steps", ()))


def wait_words(reason: WaitReason) -> str:
    """Return what a plan waits for."""
    return "the next object" if reason is WaitReason.NEXT_OBJECT else "the first object, on the empty table"


def limitation_words(limitation: Limitation) -> str:
    """Return what a stopping rule does not guarantee, as a sentence without its full stop."""
    v = limitation.values
    match limitation.code:
        case LimitationCode.SAMPLED:
            return (
                f"only {v['searched']} of {counted(v['objects'], 'object')} were searched for, so no rate is "
                "guaranteed; fit the rule to all of them"
            )
        case LimitationCode.FALSE_REJECT_RATE:
            return (
                f"a false-reject rate of {percent(v['rate'])} needs {v['needed']} leave-one-out searches, and there "
                f"are {v['searches']}: objects that score less than every search did are unknown, a rate of "
                f"{percent(v['reached'])}"
            )
        case LimitationCode.ERROR_RATE | LimitationCode.SIMILAR_OBJECTS:
            why = (
                f"needs {v['needed']} leave-one-out searches, and there are {v['searches']}"
                if limitation.code is LimitationCode.ERROR_RATE
                else "cannot be reached, because enrolled objects are too similar"
            )
            return (
                f"an error rate of {percent(v['rate'])} {why}: a search ends at a confidence of "
                f"{percent(v['min_confidence'], 0)}, at which {v['wrong']} of {v['ended']} were wrong"
            )
        case LimitationCode.FALSE_ACCEPT_RATE:
            return (
                f"on an unchanged bench, more than {percent(v['rate'])} of the objects that are not enrolled may be "
                f"accepted, because enrolled objects are too similar: {v['accepted']} of {v['searches']} left-out "
                f"objects were ({percent(v['accepted'] / v['searches'])})"
            )
        case LimitationCode.UNKNOWN_NOT_MEASURED:
            return "unknown objects cannot be measured with fewer than three objects; enroll more"
        case LimitationCode.ONE_OBJECT:
            return (
                "with one object there is no other candidate: it is found by the similarity to its own views alone, "
                "and no rate is guaranteed; enroll more"
            )
        case LimitationCode.SINGLE_VIEWS:
            return (
                "no rule can be fitted to objects with a single view: no object is called unknown, and no rate is "
                "guaranteed; enroll more"
            )


def _some(names: list[str]) -> str:
    return joined(names[:3]) if len(names) <= 3 else f"{', '.join(names[:3])} and {len(names) - 3} more"
