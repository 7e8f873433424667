"""The stopping rule of a catalog: stored beside it, and fitted again when the catalog changes.

See docs/decisions/0010-keep-what-is-derived-in-a-cache.md.
"""

import json
from dataclasses import dataclass, fields, replace
from hashlib import sha256
from importlib.metadata import version
from math import inf, nan
from pathlib import Path
from typing import Any, Final

import numpy as np

import hbr
from hbr.dense.filter import BETA
from hbr.dense.fitting import ERROR_RATE, FALSE_REJECT
from hbr.dense.index import POWER
from hbr.dense.stopping import NUMBERS, Limitation, LimitationCode, OpenSetModel, ShiftRates
from hbr.descriptors import descriptor
from rig.core.errors import CatalogError, os_errors_as
from rig.core.files import json_values, read, write
from rig.core.json_form import plain
from rig.core.next_steps import Do
from rig.events.events import Note, NoteCode

FILE: Final = "search_rules.json"
"""Beside ``catalog.sqlite``."""
FORMAT: Final = "hbr-rig search rules"
MAX_FILE_BYTES: Final = 16_000_000  # usual scores of some 100,000 objects; a larger file is not read into memory
VERSION: Final = 1
THRESHOLDS: Final = (
    "open_set_thresholds",
    "unknown_thresholds",
    "changed_bench_thresholds",
    "same_bench_thresholds",
    "leave_one_out_thresholds",
)
"""The fields of a rule with one score for each number of views; -inf is null in the file."""

_CHUNK: Final = 16_384
"""Views whose digest is computed at once."""
_KNOWN_SHARE: Final = 0.5  # with less, most objects have no usual score, and the rule is one of another catalog
_QUICK_S: Final = 0.4
_LEAST_QUICK_S: Final = 0.08
_LOADED_S: Final = 5e-6
"""Time for a fit while the operator waits, its minimum, and its reduction by each loaded view."""
_SEARCH_S, _VIEW_S = 1.4e-3, 1.3e-6
"""Time of a leave-one-out search, and its increase with each enrolled view."""
_QUICK_SHIFTED: Final = 80
"""Searches under changes of the bench while the operator waits; each takes about 10 ms."""


def quick_stopping_rule(
    index: hbr.DenseIndex, *, error_rate: float = ERROR_RATE, false_reject: float = FALSE_REJECT
) -> hbr.StoppingRule:
    """Return a stopping rule that is fitted to as many objects as about 0.4 s allow."""
    budget_s = max(_QUICK_S - _LOADED_S * len(index.views), _LEAST_QUICK_S)
    searches = _affordable(len(index.views), budget_s)
    sample = None
    if searches < len(index):
        # The fit searches for each object of a sample once, among the others of the sample.
        each = len(index.views) // len(index)
        sample = next(n for n in range(len(index), 0, -1) if n <= max(1, _affordable(n * each, budget_s)))
    return hbr.fit_stopping_rule(
        index,
        error_rate=error_rate,
        false_reject=false_reject,
        most_searches=searches if sample is None else len(index),
        most_shifted_searches=_QUICK_SHIFTED,
        sample=sample,
    ).rule


def _affordable(views: int, budget_s: float) -> int:
    """Return the number of searches among this number of enrolled views that fit into the time."""
    return int(budget_s / (_SEARCH_S + _VIEW_S * views))


@dataclass(frozen=True, eq=False)
class StoredRule:
    """A stopping rule with the model that it was fitted to.

    Attributes
    ----------
    rule : hbr.StoppingRule
        Its ``usual_scores`` are in the order of `objects`.
    objects
        Names of the objects.
    sha256
        Digest of the model (`digest`).
    made_utc
        Time of the fit, in the format of ISO 8601.
    """

    rule: hbr.StoppingRule
    objects: tuple[str, ...]
    sha256: str
    made_utc: str

    def adapted(self, views: hbr.Views) -> hbr.StoppingRule:
        """Return the rule for other views; objects that it does not know have typical scores."""
        usual = self.rule.usual_scores
        typical = np.median(usual, axis=0)
        rows = {name: row for row, name in enumerate(self.objects)}
        return replace(
            self.rule,
            usual_scores=np.array([usual[rows[name]] if name in rows else typical for name in views.object_names]),
        )


def digest(index: hbr.DenseIndex) -> str:
    """Return a digest of a model: its objects, their views, the descriptor's version, and the program that searches."""
    views = index.views
    kind = descriptor(views.descriptor)
    searched = [version("hbr-rig"), kind.name, kind.version, index.omega, POWER, BETA]
    found = sha256(json.dumps([searched, views.object_names], ensure_ascii=False).encode())
    for column in (views.object_index.astype("<i8"), views.azimuth_deg.astype("<f8")):
        found.update(np.ascontiguousarray(column).data)
    for start in range(0, len(views), _CHUNK):
        part = views.select(np.arange(start, min(start + _CHUNK, len(views))))
        found.update(np.ascontiguousarray(part.packed()).data)
    return found.hexdigest()


def stopping_rule_of(folder: Path, index: hbr.DenseIndex) -> tuple[hbr.StoppingRule, tuple[Note, ...]]:
    """Return the stopping rule for a model, and notes for the operator about it.

    A stored rule of this model is used as it is. If the catalog has changed since, it is fitted again if that is
    quick for all objects; otherwise the stored rule is used, and new objects count as typical. If there is no rule, or
    one of another catalog, which knows less than half of the objects, a quick fit makes one.
    """
    notes: list[Note] = []
    try:
        stored = read_stopping_rule(folder)
    except CatalogError as error:
        stored = None
        notes.append(Note(NoteCode.STOPPING_RULE_UNREADABLE, {"reason": error.evidence["reason"]}))
    if stored is not None and stored.sha256 == digest(index):
        return stored.rule, (*notes, *_not_guaranteed(stored.rule))
    if stored is None:
        found = quick_stopping_rule(index)
        return found, (*notes, *_not_guaranteed(found))
    asked, before, now = stored.rule, set(stored.objects), set(index.views.object_names)
    foreign = len(now & before) < _KNOWN_SHARE * len(now)
    if foreign or _affordable(len(index.views), _QUICK_S) >= len(index):
        found = quick_stopping_rule(index, error_rate=asked.error_rate, false_reject=asked.false_reject)
        return found, (*notes, *_not_guaranteed(found))
    values = {"made": stored.made_utc[:10], "added": len(now - before), "removed": len(before - now)}
    return stored.adapted(index.views), (*notes, Note(NoteCode.STOPPING_RULE_OUTDATED, values))


def _not_guaranteed(rule: hbr.StoppingRule) -> tuple[Note, ...]:
    if not rule.limitations:
        return ()
    values: dict[str, Any] = {
        "searches": rule.searches, "error_rate": rule.error_rate, "false_reject": rule.false_reject,
    }  # fmt: skip
    for one in rule.limitations:
        if one.code is LimitationCode.FALSE_ACCEPT_RATE:
            values["false_accept"] = one.values["rate"]
    return (Note(NoteCode.RATES_NOT_GUARANTEED, values),)


def stopping_rule_values(rule: hbr.StoppingRule, index: hbr.DenseIndex, *, made_utc: str) -> dict[str, Any]:
    """Return a stopping rule as JSON values; numbers that are not finite become null."""
    views = index.views
    kind = descriptor(views.descriptor)
    usual = {name: scores.tolist() for name, scores in zip(views.object_names, rule.usual_scores, strict=True)}
    return {
        "format": FORMAT,
        "version": VERSION,
        "software": f"hbr-rig {version('hbr-rig')}",
        "made_utc": made_utc,
        "model": {
            "descriptor": {"name": kind.name, "version": kind.version},
            "objects": len(views.object_names),
            "views": len(views),
            "sha256": digest(index),
        },
        **plain(replace(rule, usual_scores=usual, open_set=None)),  # type: ignore[arg-type]
        "open_set": None
        if rule.open_set is None
        else {f.name: getattr(rule.open_set, f.name).tolist() for f in fields(rule.open_set)},
    }


def write_stopping_rule(path: Path, rule: hbr.StoppingRule, index: hbr.DenseIndex, *, made_utc: str) -> None:
    """Store a stopping rule in a file, whole or not at all.

    Raises `CatalogError`: the disk is full, or the folder may not be written to.
    """
    values = stopping_rule_values(rule, index, made_utc=made_utc)
    text = json.dumps(values, ensure_ascii=False, indent=1, allow_nan=False)
    step = (Do.FREE_DISK(), "Or make the folder writable for this user.")
    with os_errors_as(CatalogError, f"The stopping rule cannot be written to {path}.", next_step=step):
        write(path, (text + "\n").encode())


def read_stopping_rule(folder: Path) -> StoredRule | None:
    """Read the stopping rule in a folder; None if there is none."""
    path = folder / FILE
    try:
        values = json_values(read(path, max_bytes=MAX_FILE_BYTES))
        if values["format"] != FORMAT or values["version"] != VERSION:
            raise ValueError(
                f"another version of the program wrote it: its format is {values['format']} {values['version']}, "
                f"this program reads {FORMAT} {VERSION}"
            )
        # The file may be damaged or from others: every value is converted and checked.
        usual = {str(name): [float(score) for score in scores] for name, scores in values["usual_scores"].items()}
        numbers: dict[str, Any] = {name: float(values[name]) for name in ("beta", "error_rate", "false_reject")}
        thresholds: dict[str, Any] = {name: tuple(_value_or(one, -inf) for one in values[name]) for name in THRESHOLDS}
        rule = hbr.StoppingRule(
            **numbers,
            **thresholds,
            min_confidence=_value_or(values["min_confidence"], inf),
            usual_scores=np.array(list(usual.values()), np.float64),
            false_accept=_value_or(values["false_accept"], nan),
            searches=int(values["searches"]),
            limitations=tuple(
                Limitation(LimitationCode(one["code"]), dict(one["values"])) for one in values["limitations"]
            ),
            open_set=_open_set(values["open_set"]),
            rates=tuple(ShiftRates(**one) for one in values["rates"]),
        )
        # What the types do not show: the same number of views everywhere.
        views = len(rule.open_set_thresholds)
        if not {len(several) for several in thresholds.values()} <= {0, views}:
            raise ValueError("it does not have one threshold for each number of views")
        scores = rule.usual_scores
        if scores.ndim != 2 or scores.shape[1] != views or not np.isfinite(scores).all():
            raise ValueError("it does not have one usual score for each object and number of views")
        return StoredRule(rule, tuple(usual), str(values["model"]["sha256"]), str(values["made_utc"]))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, ArithmeticError) as error:
        raise CatalogError(
            f"The stopping rule in {path} cannot be read.",
            next_step=Do.FIT_STOPPING_RULE(),
            evidence={"reason": str(error)},
        ) from error


def _open_set(values: dict[str, Any] | None) -> OpenSetModel | None:
    """Return the weights of the open-set score; None if the rule has none."""
    if values is None:
        return None
    arrays = {name: np.array(values[name], np.float64) for name in ("middle", "spread", "weights", "offset")}
    views = len(arrays["offset"])
    for name, array in arrays.items():
        if array.shape != ((views,) if name == "offset" else (views, len(NUMBERS))) or not np.isfinite(array).all():
            raise ValueError(f"the {name} of its open-set score is not {views} times {len(NUMBERS)} numbers")
    if not views or not (arrays["spread"] > 0).all():
        raise ValueError("its open-set score cannot be computed")
    return OpenSetModel(**arrays)


def _value_or(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else float(value)
