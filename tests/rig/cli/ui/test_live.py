"""The display of a running plan on terminals and in pipes; pauses; prompts for the operator."""

import io
import signal
from collections.abc import Iterable
from dataclasses import replace
from itertools import islice

import pytest

from hbr import Outcome
from hbr.model.symmetry import SimilarObject
from rig.catalog import ObjectSummary
from rig.cli.ui.live import LiveView
from rig.cli.ui.prompts import TerminalOperator
from rig.cli.ui.settings import Settings
from rig.config import load_config
from rig.core.clock import SystemClock
from rig.core.errors import UsageError, ViewRejected
from rig.events.events import Event, FrameUsed, Item, SimilarObjects
from rig.motion.move import MotionTimes
from rig.plans.estimate import TimeLeft
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

    def show(events: Iterable[Event], left: TimeLeft | None = None) -> str:
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
    left = TimeLeft(MotionTimes(load_config()), events[0].angles_deg)
    text = shown([Item(3, 25, "mug-white", "enroll"), *events, SIMILAR, last], left)
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


STOPPING = """
import os, signal
from rig.catalog import OpenEnrollment
from rig.cli.main import main

add, added = OpenEnrollment.add, []

def add_and_stop(*arguments):
    stored = add(*arguments)
    added.append(stored)
    if len(added) == 2:
        os.kill(os.getpid(), signal.SIGSTOP)
    return stored

OpenEnrollment.add = add_and_stop
main()
"""
"""The program stops itself when it has stored its second view: a busy test acts before the third."""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "rig.toml").write_text(SMALL_FILE, encoding="utf-8")
    return tmp_path


def test_sigtstp_pauses_between_two_views_and_sigcont_resumes(folder):
    code = STOPPING.replace("SIGSTOP", "SIGTSTP")  # as by Ctrl+Z
    process = Program("enroll", "dice", "--views", "5", code=code, folder=folder)
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


@pytest.fixture
def asked(choose):
    def run(answers: str, kept: ObjectSummary | None = None) -> tuple[Choice, str]:
        return choose(answers, next_object(TrayItem(2, "mug", "kitchen"), 3, 25, kept))

    return run


def test_operator_is_asked_for_the_next_object(asked):
    answer, question = asked("\n")
    assert answer is Choice.CONTINUE
    assert question.startswith("3 of 25: put mug (kitchen) on the table")
    assert "\a" not in question  # a pipe makes no sound
    assert asked("s\n")[0] is Choice.SKIP
    assert asked("what?\nn\nQ\n")[0] is Choice.STOP  # after an invalid answer, the question is asked again
    assert asked("")[0] is Choice.STOP


def test_operator_is_asked_whether_an_interrupted_object_was_moved(asked):
    clock = SystemClock()
    kept = ObjectSummary("mug", "", "", clock.utc(), None, 0, 31)
    answer, question = asked("n\n", kept)
    assert answer is Choice.RESTART
    assert "31 views of an interrupted enrollment" in question
    assert asked("\n", kept)[0] is Choice.CONTINUE


def test_operator_decides_about_an_object_that_failed(choose):
    error = ViewRejected("View 3 was rejected: too dark.", next_step="Check the light.")
    for said, expected in (("\n", Choice.CONTINUE), ("s\n", Choice.SKIP), ("q\n", Choice.STOP)):
        choice, question = choose(said, after_error(error, TrayItem(2, "mug")))
        assert choice is expected
        assert "too dark" in question
        assert "Check the light" in question


def test_unreadable_input_is_a_usage_error(monkeypatch):
    class Closed(io.StringIO):
        def readline(self, *_: object) -> str:
            raise OSError("no input")

    monkeypatch.setattr("sys.stdin", Closed())
    with pytest.raises(UsageError):
        TerminalOperator().choose(next_object(TrayItem(2, "mug"), 1, 1, None))
