"""Random operations on a shared catalog, and a search for a serial order that explains their results.

An operation takes effect at one moment between its call and its return (strict serializability). One that was killed
may have had its effect at any later moment, or none.
"""

import json
import random
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rig.catalog import Catalog
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import SystemClock
from rig.core.errors import RigError
from tests.rig.catalog.catalog_samples import PROVENANCE, image, plan, record

NAMES = ("mug", "tin", "star")
VIEWS = 2


class Operation(NamedTuple):
    """An operation: ``result`` is None if it was killed."""

    process: int
    begun_ns: int
    ended_ns: int | None
    name: str
    arguments: tuple[Any, ...]
    result: Any


class Entry(NamedTuple):
    """An object of the model: its name, its place among the deleted ones, and the views of its enrollments."""

    name: str
    deleted: int
    complete: int
    unfinished: int
    owner: str


State = tuple[Entry, ...]
FAILED = ("ObjectExists", "ObjectNotFound", "CatalogError")


def apply(state: State, operation: Operation) -> tuple[State, Any]:
    """Return the state after an operation, and what it returns."""
    found = {"list": _list, "begin": _begin, "add": _add, "finish": _finish}.get(operation.name, _edit)
    return found(state, operation)


def _in_use(state: State, name: str) -> int | None:
    return next((i for i, one in enumerate(state) if one.name == name and not one.deleted), None)


def _with(state: State, place: int, **changes: Any) -> State:
    return (*state[:place], state[place]._replace(**changes), *state[place + 1 :])


def _list(state: State, _: Operation) -> tuple[State, Any]:
    return state, sorted([one.name, max(one.complete, 0), one.unfinished] for one in state if not one.deleted)


def _begin(state: State, operation: Operation) -> tuple[State, Any]:
    name, owner = operation.arguments
    place = _in_use(state, name)
    if place is None:
        return (*state, Entry(name, 0, -1, 0, owner)), "done"
    if state[place].unfinished >= 0:
        return state, "CatalogError"
    return state, "ObjectExists"


def _add(state: State, operation: Operation) -> tuple[State, Any]:
    owner = operation.arguments[0]
    place = next((i for i, one in enumerate(state) if one.owner == owner), None)
    if place is None or state[place].deleted:
        return state, "CatalogError"
    return _with(state, place, unfinished=state[place].unfinished + 1), "done"


def _finish(state: State, operation: Operation) -> tuple[State, Any]:
    owner = operation.arguments[0]
    place = next((i for i, one in enumerate(state) if one.owner == owner), None)
    if place is None or state[place].deleted or state[place].unfinished < VIEWS:
        return state, "CatalogError"
    return _with(state, place, complete=state[place].unfinished, unfinished=-1, owner=""), "done"


def _edit(state: State, operation: Operation) -> tuple[State, Any]:
    name, *others = operation.arguments
    if operation.name == "undelete":
        gone = [(one.deleted, i) for i, one in enumerate(state) if one.name == name and one.deleted]
        if not gone:
            return state, "ObjectNotFound"
        if _in_use(state, name) is not None:
            return state, "ObjectExists"
        return _with(state, max(gone)[1], deleted=0), "done"
    place = _in_use(state, name)
    if place is None:
        return state, "ObjectNotFound"
    if operation.name == "delete":
        return _with(state, place, deleted=1 + max(one.deleted for one in state)), "done"
    if others[0] != name and _in_use(state, others[0]) is not None:
        return state, "ObjectExists"
    return _with(state, place, name=others[0]), "done"


def serial_order(operations: Sequence[Operation]) -> list[Operation] | None:
    """Return an order in which the operations, one after the other, return the same; None if there is none."""
    by_process: dict[int, list[Operation]] = {}
    for one in sorted(operations, key=lambda one: one.begun_ns):
        by_process.setdefault(one.process, []).append(one)
    lists = list(by_process.values())
    seen: set[tuple[tuple[int, ...], State]] = set()
    stack: list[tuple[tuple[int, ...], State, tuple[Any, ...] | None]] = [((0,) * len(lists), (), None)]
    while stack:
        places, state, order = stack.pop()
        if all(place == len(own) or own[place].result is None for place, own in zip(places, lists, strict=True)):
            return _unrolled(order)
        if (places, state) in seen:
            continue
        seen.add((places, state))
        waiting = [
            (i, own[place]) for i, (place, own) in enumerate(zip(places, lists, strict=True)) if place < len(own)
        ]
        first_end = min((one.ended_ns for _, one in waiting if one.ended_ns is not None), default=None)
        for i, one in waiting:
            if first_end is not None and one.begun_ns > first_end:
                continue  # another operation had returned before this one was called
            after, result = apply(state, one)
            if one.result is None or result == one.result:
                further = (*places[:i], places[i] + 1, *places[i + 1 :])
                stack.append((further, after, (one, order)))
            if one.result is None:  # it had no effect
                stack.append(((*places[:i], places[i] + 1, *places[i + 1 :]), state, order))
    return None


def _unrolled(order: tuple[Any, ...] | None) -> list[Operation]:
    found = []
    while order is not None:
        one, order = order
        found.append(one)
    return found[::-1]


def read_log(path: Path, process: int) -> Iterator[Operation]:
    """Yield the operations of a process from its log; the last may have been killed."""
    begun = None
    for line in path.read_text().splitlines():
        values = json.loads(line)
        if "result" in values:
            assert begun is not None
            name, arguments = begun["operation"], tuple(begun["arguments"])
            yield Operation(process, begun["at"], values["at"], name, arguments, values["result"])
            begun = None
        else:
            begun = values
    if begun is not None:
        yield Operation(process, begun["at"], None, begun["operation"], tuple(begun["arguments"]), None)


def main() -> None:
    """Run random operations: folder, URL, log, number of the process, and number of operations."""
    folder, url, log, process, count = sys.argv[1:6]
    clock, rng = SystemClock(), random.Random(int(process))
    with (
        Path(log).open("w", buffering=1) as file,
        Catalog.open(CatalogPlace(Path(folder), url), clock=clock) as catalog,
    ):

        def logged(operation: str, *arguments: Any, call: Any) -> Any:
            at = clock.now_ns()
            file.write(json.dumps({"operation": operation, "arguments": arguments, "at": at}) + "\n")
            value = None
            try:
                value = call()
                result: Any = value if operation == "list" else "done"
            except RigError as error:
                result = type(error).__name__
                if result not in FAILED:
                    raise
            file.write(json.dumps({"result": result, "at": clock.now_ns()}) + "\n")
            return value

        for number in range(int(count)):
            name, other = rng.choice(NAMES), rng.choice(NAMES)
            match rng.choice(["enroll", "enroll", "rename", "delete", "undelete", "list", "list"]):
                case "enroll":
                    owner = f"{process}-{number}"

                    def begin(name: str = name) -> Any:
                        return catalog.begin(name, planned_azimuth_deg=plan(VIEWS), provenance=PROVENANCE)

                    enrollment = logged("begin", name, owner, call=begin)
                    if enrollment is None:
                        continue
                    for index in range(VIEWS):
                        view = record(index)
                        logged("add", owner, index, call=lambda v=view, e=enrollment: e.add(v, image(v.index)))
                    logged("finish", owner, call=enrollment.finish)
                case "rename":
                    logged("rename", name, other, call=lambda a=name, b=other: catalog.rename(a, b))
                case "delete":
                    logged("delete", name, call=lambda a=name: catalog.delete(a))
                case "undelete":
                    logged("undelete", name, call=lambda a=name: catalog.undelete(a))
                case "list":

                    def listed() -> list[Any]:
                        found = catalog.objects()
                        return sorted(
                            [one.name, one.views, -1 if one.unfinished_views is None else one.unfinished_views]
                            for one in found
                        )

                    logged("list", call=listed)
