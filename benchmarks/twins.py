"""Searches on the simulated bench for objects with a near twin in the catalog.

`python -m benchmarks.twins [--searches 200] [--views 36] [--modes dense,arc] [--alone] [--seed 0] [--json FILE]
[--catalog FOLDER]`

Ten pairs of objects differ in one sticker, marking, handle, lid or letter. Both objects of each pair are enrolled. Each
search puts one of them on the table in a random orientation. With ``--alone`` only the first of each pair is enrolled,
and half of the searches are for its twin, which is not enrolled. ``--catalog`` keeps the catalog in a new folder, for
`rig eval`.
"""

import argparse
import json
import sys
import time
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from calibration.procedures import CameraTime
from hbr.evaluation.statistics import wilson
from rig import Catalog, enroll, identify, load_model
from rig.calibrations import CalibrationResult, apply_results
from rig.config import load_config
from rig.events.events import Identified
from sim.bench import ShelfOperator, open_sim_bench
from sim.noise import NoiseModel
from sim.objects.shelf import CONFUSABLE, MORE_CONFUSABLE, twins
from sim.world import World

PAIRS = (*CONFUSABLE, *MORE_CONFUSABLE)


def main() -> None:
    options = argparse.ArgumentParser()
    options.add_argument("--searches", type=int, default=200)
    options.add_argument("--views", type=int, default=36)
    options.add_argument("--modes", default="dense,arc")
    options.add_argument("--alone", action="store_true")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--json", type=Path)
    options.add_argument("--catalog", type=Path)
    given = options.parse_args()
    rows = searches(given)
    print(json.dumps(summary(rows), indent=2))
    if given.json:
        given.json.write_text(json.dumps({"summary": summary(rows), "rows": rows}, indent=1) + "\n")


def calibrated(operator: ShelfOperator, thing: str) -> Any:
    """Return the configuration with the camera's time, which is calibrated before."""
    config = load_config(None, ())
    with open_sim_bench(config, operator) as bench:
        *_, result = CameraTime(thing).live(bench)
        assert isinstance(result, CalibrationResult)
        assert result.passed, result.rejections
        return apply_results(config, [result])[0]


def searches(given: argparse.Namespace) -> list[dict[str, Any]]:
    """Enroll, and search; return a row for each search in each mode."""
    things = twins()
    world = World(seed=given.seed, noise=NoiseModel())
    operator = ShelfOperator(world, things)
    config = calibrated(ShelfOperator(world, things), "mug-star")
    rng = np.random.default_rng(given.seed)
    known = [pair[0] for pair in PAIRS] if given.alone else list(things)
    rows: list[dict[str, Any]] = []
    with (
        TemporaryDirectory() as folder,
        open_sim_bench(config, operator) as bench,
        Catalog.open(given.catalog or Path(folder), clock=bench.clock) as catalog,
    ):
        for name in known:
            for _ in enroll(bench, catalog, name, views=given.views):
                pass
        model = load_model(catalog)
        for number in range(given.searches):
            name = list(things)[number % len(things)]
            operator.next_object, operator.yaw_deg = name, float(rng.uniform(0, 360))
            for mode in given.modes.split(","):
                begun = time.process_time()
                answer = None
                for event in identify(bench, model, strategy=mode):
                    answer = event if isinstance(event, Identified) else answer
                assert answer is not None
                row = {
                    "mode": mode,
                    "object": name,
                    "known": name in known,
                    "outcome": answer.outcome.value,
                    "name": answer.name,
                    "possible": answer.possible,
                    "reason": answer.reason.value,
                    "confidence": answer.confidence,
                    "views": answer.views,
                    "seconds": answer.seconds,
                    "cpu_s": time.process_time() - begun,
                }
                rows.append(row)
                print(json.dumps(row), file=sys.stderr, flush=True)
    return rows


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the number of answers of each kind by mode; the interval is one of 95 %."""
    result: dict[str, Any] = {}
    for mode in dict.fromkeys(row["mode"] for row in rows):
        own = [row for row in rows if row["mode"] == mode]
        kinds = Counter(kind_of(row) for row in own)
        wrong = kinds["wrong"]
        result[mode] = {
            "searches": len(own),
            **kinds,
            "wrong_share": [wrong / len(own), *wilson(wrong, len(own))],
            "views": float(np.mean([row["views"] for row in own])),
            "seconds": float(np.mean([row["seconds"] for row in own])),
            "reasons": Counter(f"{kind_of(row)}, {row['reason']}" for row in own),
            "pairs": {
                " / ".join(pair): Counter(kind_of(row) for row in own if row["object"] in pair) for pair in PAIRS
            },
        }
    return result


def kind_of(row: dict[str, Any]) -> str:
    """Return the kind of an answer: found, wrong, ambiguous, or unknown."""
    if row["outcome"] != "found":
        return str(row["outcome"])
    return "found" if row["name"] == row["object"] else "wrong"


if __name__ == "__main__":
    main()
