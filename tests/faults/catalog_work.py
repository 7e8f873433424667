"""Work on a catalog that a kill or a full disk interrupts, and a program that kills it again and again.

Arguments of the program: FOLDER KILLS SEED NAME. FOLDER/home is the state before the work, with the catalogs
``catalog`` and ``other``. Every run works on a copy, FOLDER/NAME/<number>, in a child process (`tests.faults.kills`).
The program prints one line of JSON for each child: its number and the views that it reported.
"""

import json
import shutil
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import sqlalchemy

from rig.catalog import Catalog, derived
from rig.catalog.facts import Derived
from rig.catalog.jobs import finished
from rig.catalog.results import correct, find_results
from rig.catalog.results import record as record_result
from rig.catalog.retake import Retake
from rig.catalog.transfer import CatalogSource, Conflict, transfer
from rig.catalog.upkeep import collect_garbage
from rig.core.clock import SystemClock
from tests.faults.kills import killed_child, points
from tests.rig.catalog.catalog_samples import PROVENANCE, fill, image, new_result, plan, record

VIEWS = 4
EMPTY_TABLE = image(99)
Report = Callable[[int], object]


def opened(home: Path, name: str = "catalog") -> Catalog:
    return Catalog.open(home / name, clock=SystemClock())


def prepare(home: Path) -> None:
    """Make the catalogs on which the work starts."""
    with opened(home) as catalog:
        for number, name in enumerate(("mug", "tin", "gone")):
            fill(catalog, name, 2, 10 * number, label="kitchen", empty_table=EMPTY_TABLE)
        fill(catalog, "tin", 3, 50, replace=True)
        catalog.delete("gone")
        begun = catalog.begin("begun", planned_azimuth_deg=plan(VIEWS), provenance=PROVENANCE)
        begun.add(record(0), image(30))
        record_result(catalog, new_result(sample="S-1"), image(1))
    with opened(home, "other") as other:
        fill(other, "jar", 3, 70, empty_table=EMPTY_TABLE)
        fill(other, "mug", 2, 80)
        fill(other, "vase", 2, 0)  # with images that the catalog has already


def _enroll(catalog: Catalog, report: Report, name: str, **begin: Any) -> None:
    enrollment = catalog.begin(
        name, planned_azimuth_deg=plan(VIEWS), provenance=PROVENANCE, empty_table=EMPTY_TABLE, **begin
    )
    _continue(enrollment, report)


def _continue(enrollment: Any, report: Report) -> None:
    for index in enrollment.missing():
        enrollment.add(record(index), image(30 + index))
        report(index)
    enrollment.finish()


def enroll(catalog: Catalog, report: Report) -> None:
    """Enroll, or continue after an interruption."""
    if not any(one.name == "new" for one in catalog.objects()):
        _enroll(catalog, report, "new")
    elif catalog.resumable("new") is not None:
        _continue(catalog.resume("new", provenance=PROVENANCE, empty_table=EMPTY_TABLE), report)


def enroll_again(catalog: Catalog, report: Report) -> None:
    if catalog.resumable("mug") is not None:
        _continue(catalog.resume("mug", provenance=PROVENANCE), report)
    elif catalog.object("mug").summary.views != VIEWS:
        _enroll(catalog, report, "mug", replace=True)


def take_again(catalog: Catalog, _: Report) -> None:
    if not any("taken_again" in line.details for line in catalog.log()):
        begun = Retake.of(catalog, "mug", [1], provenance=PROVENANCE, empty_table=EMPTY_TABLE)
        begun.add(record(1), image(31))
        begun.finish()


def continue_(catalog: Catalog, report: Report) -> None:
    if catalog.resumable("begun") is not None:
        _continue(catalog.resume("begun", provenance=PROVENANCE), report)


def move(catalog: Catalog, _: Report) -> None:
    with opened(catalog.path.parent, "other") as other:
        finished(transfer(CatalogSource(other), catalog, conflict=Conflict.SKIP, jobs=1))


def replace(catalog: Catalog, _: Report) -> None:
    with opened(catalog.path.parent, "other") as other:
        finished(transfer(CatalogSource(other), catalog, conflict=Conflict.REPLACE, jobs=1))


def delete(catalog: Catalog, _: Report) -> None:
    if any(one.name == "mug" for one in catalog.objects()):
        catalog.delete("mug", "tin")


def restore(catalog: Catalog, _: Report) -> None:
    if catalog.objects(deleted=True):
        catalog.undelete("gone")


def gc(catalog: Catalog, _: Report) -> None:
    collect_garbage(catalog, old=True)


def rename(catalog: Catalog, _: Report) -> None:
    if any(one.name == "mug" for one in catalog.objects()):
        catalog.rename("mug", "cup")


def answer(catalog: Catalog, _: Report) -> None:
    if len(find_results(catalog)) < 2:
        record_result(catalog, new_result(sample="S-2"), image(2))


def put_right(catalog: Catalog, _: Report) -> None:
    if not find_results(catalog)[0].corrections:
        correct(catalog, 1, unknown=True, reason="read the label")


def describe(catalog: Catalog, _: Report) -> None:
    with catalog.database.write() as transaction:
        transaction.execute(sqlalchemy.delete(Derived))  # nothing of it is a fact: all of it is computed again
    derived.views(catalog)


WORK: dict[str, Callable[[Catalog, Report], None]] = {
    "enroll": enroll,
    "enroll again": enroll_again,
    "continue": continue_,
    "take again": take_again,
    "transfer": move,
    "replace": replace,
    "delete": delete,
    "restore": restore,
    "gc": gc,
    "rename": rename,
    "answer": answer,
    "correct": put_right,
    "describe": describe,
}
"""Each can be done again after an interruption, and completes then."""


def run(name: str, home: Path, report: Report) -> None:
    with opened(home) as catalog:
        WORK[name](catalog, report)


def main() -> None:
    folder, kills, seed, name = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), sys.argv[4]

    def begin(number: str) -> Path:
        return Path(shutil.copytree(folder / "home", folder / name / number))

    run(name, begin("warm-up"), lambda _: None)  # the first run stores byte code
    counted = partial(run, name, begin("complete"), lambda _: None)
    for number, (point, delay_s) in enumerate(points(counted, kills, seed)):
        reported = killed_child(partial(run, name, begin(str(number))), point, delay_s)
        print(json.dumps({"number": number, "reported": reported}), flush=True)
