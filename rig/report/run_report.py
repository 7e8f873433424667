"""The report of a saved run."""

from datetime import datetime

from rig.events.wording import answer_words, outcome_words
from rig.report.page import Meta, render_report
from rig.report.records import IdentificationRecord
from rig.search.saved_run import SavedRun


def run_report(saved: SavedRun) -> str:
    """Return the page about a saved run: the answer, the camera's path, the scores, the views and the decisions.

    Raises
    ------
    UsageError
        The run is damaged.
    """
    record = IdentificationRecord(region=saved.config.view.roi)
    about = saved.about
    with saved.damage():
        for event in saved.events():
            record.add(event)
        answer = record.answer
        found = "no answer" if answer is None else outcome_words(answer)
        summary = answer_words(answer) if answer else "The search ended without an answer."
        meta = Meta(
            conditions={"bench": about["bench"], **record.conditions, "devices": about["devices"]},
            wall_clock={"software": about["software"]},
            date=datetime.fromisoformat(about["started_utc"]),
        )
        return render_report(f"Search: {found}", summary, [], [record], meta=meta)
