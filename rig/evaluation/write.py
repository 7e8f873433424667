"""The files that an evaluation leaves."""

import json
from pathlib import Path
from typing import Any

from hbr.evaluation.protocol import Runs
from rig.evaluation.plan import Plan
from rig.evaluation.report import csv_text, evaluate


def write_results(plan: Plan, runs: Runs, margin: float, min_views: int, folder: Path) -> dict[str, Any]:
    """Write results.json and results.csv, and return the results."""
    results = evaluate(plan, runs, margin, min_views)
    (folder / "results.json").write_text(json.dumps(results, ensure_ascii=False, indent=1) + "\n", encoding="utf-8")
    (folder / "results.csv").write_text(csv_text(results), encoding="utf-8")
    return results
