"""Searches in motion compared with searches at rest, on the simulated bench.

`python -m benchmarks.fly_search [--trials 300] [--views 36] [--seed 0] [--json FILE]`

All built-in objects but three are enrolled at rest, two pairs of twins among them. Each trial puts an object on the
table in a random orientation, an unknown one in every fifth trial, and searches for it at rest and in motion. The
camera's time is calibrated first, and 1 % of the frames are lost.
"""

import argparse
import json
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.fly_enrollment import NOISE, calibrated
from hbr.core.angles import wrap180
from hbr.evaluation.statistics import mcnemar_exact, wilson
from rig import Catalog, enroll, identify, load_model
from rig.events.events import Accepted, Identified
from sim.bench import ShelfOperator, open_sim_bench
from sim.objects.shelf import shelf
from sim.world import World

KINDS = ("rest", "motion")
UNKNOWN_EVERY = 5


def main() -> None:
    options = argparse.ArgumentParser()
    options.add_argument("--trials", type=int, default=300)
    options.add_argument("--views", type=int, default=36)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--json", type=Path)
    given = options.parse_args()
    things = shelf()
    names = list(things)
    unknown, known = names[2::5][:3], [name for name in names if name not in names[2::5][:3]]
    world = World(seed=given.seed, noise=NOISE)
    operator = ShelfOperator(world, things)
    config, _ = calibrated(ShelfOperator(world, things), "mug-star")
    rng = np.random.default_rng(given.seed)
    rows: list[dict[str, Any]] = []
    with TemporaryDirectory() as folder, open_sim_bench(config, operator) as bench:
        with Catalog.open(Path(folder), clock=bench.clock) as catalog:
            for name in known:
                for _ in enroll(bench, catalog, name, views=given.views, fly=False):
                    pass
            model = load_model(catalog)
        for trial in range(given.trials):
            name = str(rng.choice(unknown if trial % UNKNOWN_EVERY == UNKNOWN_EVERY - 1 else known))
            operator.next_object, operator.yaw_deg = name, float(rng.uniform(0, 360))
            row: dict[str, Any] = {"object": name, "known": name in known}
            for kind in KINDS:
                begun, frames = time.process_time(), 0
                for event in identify(bench, model, strategy="dense" if kind == "rest" else "arc"):
                    frames += isinstance(event, Accepted)
                assert isinstance(event, Identified)
                found = event.name if event.outcome.value == "found" else event.outcome.value
                yaw = None if event.yaw_deg is None else float(wrap180(event.yaw_deg - operator.yaw_deg))
                row[kind] = {
                    "found": found,
                    "right": found == (name if row["known"] else "unknown"),
                    "seconds": event.seconds,
                    "views": event.views,
                    "travelled_deg": event.travelled_deg,
                    "yaw_error_deg": yaw,
                    "cpu_s": time.process_time() - begun,
                }
            rows.append(row)
            print(json.dumps(row), file=sys.stderr, flush=True)
            if given.json:
                given.json.write_text(json.dumps({"summary": summary(rows), "rows": rows}, indent=1) + "\n")
    print(json.dumps(summary(rows), indent=2))


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return rates with intervals of 95 %, and times, of the pairs so far."""
    known = [row for row in rows if row["known"]]
    several = [row for row in known if row["rest"]["views"] > 1]
    one = [row for row in known if row["rest"]["views"] == 1]
    others = [row for row in rows if not row["known"]]
    result: dict[str, Any] = {"trials": len(rows), "known": len(known), "unknown": len(others)}
    for kind in KINDS:
        named = [row for row in rows if row[kind]["found"] not in ("unknown", "ambiguous")]
        wrong = sum(row[kind]["found"] != row["object"] for row in named)
        rejected = sum(row[kind]["found"] == "unknown" for row in known)
        ok = [row for row in others if row[kind]["right"]]
        result[kind] = {
            "right": sum(row[kind]["right"] for row in rows),
            "wrong_among_named": [wrong, len(named), *wilson(wrong, len(named))] if named else None,
            "false_reject": [rejected, len(known), *wilson(rejected, len(known))] if known else None,
            "unknown_recognised": [len(ok), len(others)],
            "seconds_one_view": mean(row[kind]["seconds"] for row in one),
            "seconds_several_views": mean(row[kind]["seconds"] for row in several),
            "seconds_unknown": mean(row[kind]["seconds"] for row in others),
        }
    only = [sum(row[a]["right"] and not row[b]["right"] for row in rows) for a, b in (KINDS, KINDS[::-1])]
    return result | {"several_views": len(several), "only_one_right": only, "mcnemar_p": mcnemar_exact(*only)}


def mean(values: Any) -> float | None:
    """Return the mean; None if there are no values."""
    found = list(values)
    return float(np.mean(found)) if found else None


if __name__ == "__main__":
    main()
