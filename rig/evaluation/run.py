"""Runs an experiment, with several objects in parallel processes, and writes its results."""

import csv
import io
import json
import re
from collections.abc import Callable, Mapping
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, Final, TypeVar

from hbr.evaluation.changes import BENCH_CHANGE
from hbr.evaluation.experiment import Experiment
from hbr.evaluation.photographs import Dataset
from hbr.evaluation.trials import TRIALS
from rig.core.clock import SystemClock
from rig.core.errors import UsageError, os_errors_as
from rig.core.files import write
from rig.core.next_steps import Do
from rig.core.processes import map_in_processes
from rig.evaluation.figures import figures
from rig.evaluation.tables import rows_of

FOLDER: Final = Path("rig-eval")
"""The folder of all results without a folder of their own choice."""
_MAX_NAME: Final = 60  # the end of a name distinguishes runs, and file systems end names at 255 bytes
_T = TypeVar("_T")


def run_experiment(
    experiment: Experiment, dataset: Dataset, jobs: int, advance: Callable[[str, str], None]
) -> dict[str, Any]:
    """Return the results as JSON values; they do not depend on `jobs`.

    `advance` is called with "described" and "searched" and the name of each object.

    Raises `DatasetError`, `ValueError`: a photograph cannot be used, or there are too few objects or views for the
    experiment.
    """
    kind, dataset = TRIALS if experiment.change is None else BENCH_CHANGE, dataset.every(experiment.every)

    def of_each(work: Callable[[int], _T], done: str) -> list[_T]:
        found: dict[int, _T] = {}
        for j, one in map_in_processes(work, range(len(dataset.objects)), jobs):
            found[j] = one
            advance(done, dataset.objects[j].name)
        return [found[j] for j in range(len(dataset.objects))]

    model = kind.model(experiment, dataset, of_each(partial(kind.enroll, experiment, dataset), "described"))
    # the clock measures the steps of a search; hbr has none
    search = partial(kind.search, experiment, dataset, model, SystemClock().now_ns)
    return kind.results(experiment, dataset, model, of_each(search, "searched"))


def own_folder(experiment: Experiment, dataset: Dataset) -> Path:
    """Return the folder of these results: the same for equal experiments on equal data sets, and another for others."""
    reported = {"report": experiment.report}
    digest = sha256(json.dumps(experiment.settings(dataset) | reported, sort_keys=True).encode()).hexdigest()[:8]
    name = f"{dataset.name}-{experiment.name}-{experiment.condition.noise}"
    words = re.sub(r"[^\w.+-]+", "-", name).strip("-.")[-_MAX_NAME:]
    return FOLDER / f"{words}-{digest}"


def write_results(results: Mapping[str, Any], folder: Path) -> None:
    """Write results.json, results.csv and the figures; a missing folder is created.

    Raises `UsageError`: the folder cannot be written.
    """
    text = io.StringIO()
    rows = rows_of(results)
    writer = csv.DictWriter(text, rows[0].keys(), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    files = {
        "results.json": json.dumps(results, ensure_ascii=False, allow_nan=False, indent=1).encode() + b"\n",
        "results.csv": text.getvalue().encode(),
    }
    if "methods" in results:
        files |= {f"{name}.svg": figure.svg(alone=True).encode() for name, figure in figures(dict(results)).items()}
    step = Do.RUN_AGAIN(out="FOLDER")
    with os_errors_as(UsageError, f"The results cannot be written to {folder}.", next_step=step):
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in files.items():
            write(folder / name, data)
