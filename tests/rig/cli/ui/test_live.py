"""The display of a running plan on terminals and in pipes; pauses; prompts for the operator."""

import io
import signal
from collections.abc import Callable, Iterable
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from itertools import islice

import pytest

from hbr import Outcome
from hbr.model.symmetry import SimilarObject
from rig.catalog import ObjectSummary
from rig.cli.ui.live import LiveView
from rig.cli.ui.prompts import TerminalOperator
from rig.cli.ui.settings import Settings
from rig.config import load_config
from rig.core.errors import UsageError, ViewRejected
from rig.events.events import Event, FrameUsed, Item, SimilarObjects
from rig.motion.move import MotionTimes
from rig.plans.operator import Choice, Question
from rig.plans.tray import TrayItem, after_error, next_object
from tests.programs import Program
from tests.rig.report.report_samples import enrolling, searching_densely
from tests.small import SMALL_FILE

SIMILAR = SimilarObjects(
    "mug-white", 180.0, 0.95, 0.96, (SimilarObject("mug-03", ((120.0, 200.0),), ((210.0, 110.0),), (), 0.2, 0.99),)
)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture(params=[Terminal, io.StringIO])
def shown(request, monkeypatch):
    """Return a function that shows events on a terminal, and in a pipe; it returns all that was printed."""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "200")
    output = request.param()

    def show(events: Iterable[Event], left: Callable[[int], float] | None = None) -> str:
        monkeypatch.setattr("sys.stdout", output)
        with LiveView(Settings()) as view:
            view.left = left
            for event in events:
                view.add(event)
        return output.getvalue()

    return show


def is_terminal(text: str) -> bool:
    return "\x1b" in text


def test_enrollment_has_a_line_for_each_step_and_ends_with_similar_objects(shown):
    *events, last = enrolling(views=8, retaken=(3,))
    left = MotionTimes(load_config()).left_s
    text = shown([Item(3, 25, "mug-white", "enroll"), *events, SIMILAR, last], partial(left, events[0].angles_deg))
    assert text.startswith("3 of 25 mug-white: 8 views, about ")
    assert "view 4, attempt 1: rejected, blurred (sharpness 2.0 < 3)" in text
    assert text.count(", azimuth ") == 8
    *_, enrolled, same, like = text.splitlines()
    assert "mug-white: 8 views enrolled in " in enrolled
    assert same.startswith("  looks the same every 180°")
    assert like == "  looks like mug-03 from 120–200° (similarity up to 0.990)"
    assert ("of 8 views, " in text and "Ctrl+Z: pause" in text) == is_terminal(text)


def test_dense_search_shows_its_notes_once_and_its_decisions(shown):
    text = shown([*searching_densely(), *searching_densely()])
    assert text.count("Note: most objects were enrolled without an empty-table image") == 1
    assert "  not confident yet: 60.0 %, and 95.0 % ends the search\n" in text
    assert "  left 80.0°: distinguishes mug-white from mug-star, similarity 0.50 there (0.50–0.95 all around)" in text


def test_frames_are_lines_in_a_pipe_and_at_a_terminal_only_the_last_line(shown):
    used = FrameUsed(11, 34.8, 1.04, 2, "mug-star", 0.622, Outcome.CONTINUE)
    text = shown([*islice(searching_densely(), 4), used, replace(used, outcome=Outcome.FOUND)])
    words = "in motion: mug-star 62.2 %; view 12, azimuth 34.8°, 1.0 s (2 frames rejected)"
    assert (f"  {words}\n" in text) != is_terminal(text)
    assert is_terminal(text) or "enough to end the search" in text


def test_sigtstp_pauses_between_two_views_and_sigcont_resumes(tmp_path):
    (tmp_path / "rig.toml").write_text(SMALL_FILE, encoding="utf-8")
    # as by Ctrl+Z; the program sends it to itself, so that a busy test acts before the third view
    code = """
import os, signal
from rig.catalog import OpenEnrollment
from rig.cli.main import main

add, added = OpenEnrollment.add, []

def add_and_stop(*arguments):
    added.append(add(*arguments))
    if len(added) == 2:
        os.kill(os.getpid(), signal.SIGTSTP)
    return added[-1]

OpenEnrollment.add = add_and_stop
main()
"""
    process = Program("enroll", "dice", "--views", "5", code=code, folder=tmp_path)
    process.wait_until_stopped()
    process.send_signal(signal.SIGCONT)
    rest, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    assert "Paused. To resume: fg (or SIGCONT)." in rest
    assert "5 views enrolled" in rest


@pytest.fixture
def choose(monkeypatch, capsys):
    """Return a function that asks a question; it returns the choice by the answers, and what was asked."""

    def run(answers: str, question: Question) -> tuple[Choice, str]:
        monkeypatch.setattr("sys.stdin", io.StringIO(answers))
        return TerminalOperator().choose(question), capsys.readouterr().err

    return run


KEPT = ObjectSummary("mug", "", "", datetime(2026, 1, 1, tzinfo=UTC), None, 0, 31)
NEXT, AGAIN = (next_object(TrayItem(2, "mug", "kitchen"), 3, 25, kept) for kept in (None, KEPT))
FAILED = after_error(ViewRejected("View 3 was rejected: too dark.", next_step="Check the light."), TrayItem(2, "mug"))


@pytest.mark.parametrize(
    ("question", "answers", "choice", "words"),
    [
        (NEXT, "\n", Choice.CONTINUE, "3 of 25: put mug (kitchen) on the table"),
        (NEXT, "s\n", Choice.SKIP, ""),
        (NEXT, "what?\nn\nQ\n", Choice.STOP, ""),  # after an invalid answer, the question is asked again
        (NEXT, "", Choice.STOP, ""),
        (AGAIN, "n\n", Choice.RESTART, "31 views of an interrupted enrollment"),
        (AGAIN, "\n", Choice.CONTINUE, ""),
        (FAILED, "\n", Choice.CONTINUE, "too dark"),
        (FAILED, "s\n", Choice.SKIP, "Check the light"),
        (FAILED, "q\n", Choice.STOP, ""),
    ],
)
def test_operator_answers_at_the_terminal(choose, question, answers, choice, words):
    answer, asked = choose(answers, question)
    assert answer is choice
    assert words in asked
    assert "\a" not in asked  # a pipe makes no sound


def test_unreadable_input_is_a_usage_error(monkeypatch):
    class Closed(io.StringIO):
        def readline(self, *_: object) -> str:
            raise OSError("no input")

    monkeypatch.setattr("sys.stdin", Closed())
    with pytest.raises(UsageError):
        TerminalOperator().choose(next_object(TrayItem(2, "mug"), 1, 1, None))
