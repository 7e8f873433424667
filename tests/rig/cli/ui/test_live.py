"""The display of a running plan on terminals and in pipes; pauses; prompts for the operator."""

import io
import os
import pty
import re
import select
import signal
import termios
from dataclasses import replace
from itertools import islice
from pathlib import Path

import pytest
from rich.console import Console

from hbr import Outcome
from rig.catalog import ObjectSummary
from rig.cli.ui.keys import Pause
from rig.cli.ui.live import EnrollView, IdentifyView, LiveView
from rig.cli.ui.prompts import TerminalOperator
from rig.config import load_config
from rig.core.clock import SystemClock
from rig.core.errors import UsageError, ViewRejected
from rig.core.phrases import angle_words
from rig.events.events import (
    Accepted,
    Event,
    FrameUsed,
    Item,
    Moved,
    Rejected,
    SimilarObject,
    SimilarObjects,
    SkipReason,
    Waiting,
    WaitReason,
)
from rig.plans.operator import Choice, Question
from rig.plans.tray import TrayItem, after_error, next_object
from rig.views.capture import MotionEvidence
from tests.programs import Program
from tests.rig.report.report_samples import enrolling, identifying, searching_densely

ESCAPE = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
SIMILAR = SimilarObjects(
    "mug-white", 180.0, 0.95, 0.96, (SimilarObject("mug-03", ((120.0, 200.0),), ((210.0, 110.0),), (), 0.2, 0.99),)
)


def enrolled_with_similar_objects() -> list[Event]:
    *before, last = enrolling(views=8, retaken=(3,))
    return [*before, SIMILAR, last]


def screen(width: int, *, terminal: bool = True) -> Console:
    return Console(file=io.StringIO(), width=width, height=30, force_terminal=terminal, legacy_windows=False)


def shown(console: Console, view: LiveView, events: list[Event]) -> str:
    with view:
        for event in events:
            view.add(event)
        picture = console.render_lines(view.render(), pad=False) if console.is_terminal else []
    text = console.file.getvalue()  # type: ignore[attr-defined]
    for line in picture:
        assert sum(len(segment.text) for segment in line) <= console.width
    return ESCAPE.sub("", text)


@pytest.mark.parametrize("width", [30, 40, 60, 72, 88, 100, 200])
def test_enrollment_table_fits_the_terminal(width):
    console = screen(width)
    text = shown(console, EnrollView(console, load_config(), "3 of 25"), enrolled_with_similar_objects())
    assert "accepted" in text.replace("\n", "")
    assert ("asked" in text) == (width >= 60)
    assert ("saturated" in text) == (width >= 88)
    assert "8 views enrolled" in " ".join(text.split())


def test_enrollment_in_a_pipe_has_one_line_for_each_view():
    console = screen(80, terminal=False)
    view = EnrollView(console, load_config(), "3 of 25")
    text = shown(console, view, enrolled_with_similar_objects())
    lines = text.splitlines()
    assert lines[0].startswith("3 of 25 mug-white: 8 views, about ")
    views = [line for line in lines if line.startswith("view ")]
    assert len(views) == 9
    assert re.fullmatch(
        r"view 4 of 8  asked 135.00°  encoder 135.04°  IMU 135.14 ± 0.10°  sharpness 2.0  brightness 90  saturated 0 "
        r"%  rejected: blurred \(sharpness 2.0 < 3\)",
        views[3],
    )
    assert re.search(r"accepted  \d+ s left$", views[4])
    assert lines[-2:] == [
        "  looks the same every 180° (similarity 0.960, of neighbouring views 0.950): "
        "its pose is known up to that angle",
        "  looks like mug-03 from 120–200° (similarity up to 0.990)",
    ]


def in_motion(events: list[Event]) -> list[Event]:
    """Return events as if the views had been taken in one revolution, 45° apart."""
    return [
        replace(one, evidence=replace(one.evidence, stillness=None, motion=flight(45.0 * one.index)))
        if isinstance(one, Accepted | Rejected)
        else one
        for one in events
    ]


def flight(angle_deg: float) -> MotionEvidence:
    return MotionEvidence(0, angle_deg, 0.0612, 90.04, 3.78, 0.02)


def test_views_in_motion_have_their_own_angles_in_a_pipe():
    console = screen(80, terminal=False)
    text = shown(console, EnrollView(console, load_config()), in_motion(enrolled_with_similar_objects()))
    assert "view 2 of 8  table angle 45.00 ± 0.06°  speed and smear 90 °/s, 3.8 px  sharpness" in text
    assert "asked" not in text


@pytest.mark.parametrize("width", [30, 60, 120])
def test_views_in_motion_fit_the_terminal(width):
    console = screen(width)
    text = shown(console, EnrollView(console, load_config()), in_motion(enrolled_with_similar_objects()))
    assert "45.00 ± 0.06°" in text
    assert ("speed and smear" in text) == (width >= 60)


@pytest.mark.parametrize("width", [30, 60, 120])
@pytest.mark.parametrize("answer", ["mug-white", None])
def test_search_shows_candidates_and_decisions(width, answer):
    console = screen(width)
    text = shown(console, IdentifyView(console), [Waiting(WaitReason.NEXT_OBJECT), *identifying(answer)])
    flat = " ".join(text.split())
    assert "candidate" in flat
    assert "left 47.3°: the leading candidates look less similar there: S_left 0.41 < S_right 0.66" in flat
    assert ("similar enrolled objects are mug-white" if answer is None else "mug-white, rotated 30°") in flat
    assert "258° of rotation, 10 s." in flat


def test_search_in_a_pipe_is_printed_in_lines():
    console = screen(80, terminal=False)
    events = list(identifying())
    move = next(e for e in events if isinstance(e, Moved) and e.index == 1)
    text = shown(console, IdentifyView(console), events)
    assert f"at {angle_words(move.encoder_deg, 2)}" in text
    assert "candidates: mug-white 0.910 at 60.0°" in text
    assert "left 47.3°" in text
    assert max(map(len, text.splitlines())) > 100  # no line is broken for a terminal that is not there


@pytest.mark.parametrize("width", [30, 60, 120])
@pytest.mark.parametrize("answer", ["mug-white", None])
def test_dense_search_shows_probabilities_and_its_decisions(width, answer):
    console = screen(width)
    text = shown(console, IdentifyView(console), list(searching_densely(answer)))
    flat = " ".join(text.split())
    assert "Note: most objects were enrolled without an empty-table image" in flat
    assert "mug-white 60.0 % not confident yet: 60.0 %" in flat
    assert "left 80.0°: distinguishes mug-white from mug-star, similarity 0.50 there (0.50–0.95 all around)" in flat
    assert ("% confident (3 views)" in flat) == (answer is not None)
    assert ("Unknown object. The most similar enrolled objects are mug-white (score 0.900)" in flat) == (answer is None)


@pytest.mark.parametrize("terminal", [True, False])
def test_frames_are_shown_while_the_table_rotates(terminal: bool) -> None:
    used = FrameUsed(11, 34.8, 1.04, 2, "mug-star", 0.622, Outcome.CONTINUE)
    first = list(islice(searching_densely(), 4))
    console = screen(100, terminal=terminal)
    text = shown(console, IdentifyView(console), [*first, used])
    assert "in motion: mug-star 62.2 %; view 12, azimuth 34.8°, 1.0 s (2 frames rejected)" in text
    enough = replace(used, outcome=Outcome.FOUND)
    console = screen(100, terminal=terminal)
    assert "enough to end the search" in shown(console, IdentifyView(console), [*first, enough])


def test_dense_search_in_a_pipe_is_printed_as_lines():
    console = screen(80, terminal=False)
    lines = shown(console, IdentifyView(console), list(searching_densely())).splitlines()
    assert lines[0].startswith("Method: dense, by ")
    assert lines[1].startswith("Note: most objects were enrolled without")
    assert "  candidates: mug-white 0.900 (60.0 %) at 330.0°, mug-star 0.800 (30.0 %) at 330.0°" in lines[4]
    assert "not enrolled (10.0 %)" in lines[4]
    assert lines[5] == "  not confident yet: 60.0 %, and 95.0 % ends the search"
    assert lines[6].startswith("  left 80.0°: distinguishes mug-white from mug-star")


@pytest.mark.parametrize("width", [40, 100])
@pytest.mark.parametrize("kind", [EnrollView, IdentifyView])
def test_live_table_shows_whether_the_plan_pauses(kind, width):
    console = screen(width)
    view = kind(console, load_config()) if kind is EnrollView else kind(console)

    def content() -> str:
        lines = console.render_lines(view.render(), pad=False)
        return " ".join("".join(segment.text for segment in line) for line in lines)

    with view:
        for event in islice(enrolling(views=8) if kind is EnrollView else identifying(), 3):
            view.show(event)
        view._show_pause("Paused. p: resume")
        assert "Paused. p: resume" in content()
        assert "Ctrl+C: stop" not in content()  # the hint of the keys that work otherwise
        view._show_pause("")
        assert "Paused" not in content()
    assert "Paused" not in ESCAPE.sub("", console.file.getvalue()).splitlines()[-1]


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


class Keyboard:
    """A terminal with a program in it; what it prints is gathered."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self._master, slave = pty.openpty()
        self.before = termios.tcgetattr(slave)
        self.slave = slave
        variables = {"COLUMNS": "100", "LINES": "40", "TERM": "xterm"}
        self.process = Program(*arguments, code=STOPPING, folder=folder, terminal=slave, **variables)
        self.seen = ""

    def type(self, keys: str) -> None:
        os.write(self._master, keys.encode())

    def until(self, words: str) -> None:
        """Read until these words come."""
        while words not in self.seen:
            ended = self.process.poll() is not None
            if not select.select([self._master], [], [], 0 if ended else 30)[0]:
                raise AssertionError(f"{words!r} did not come: {self.seen}")
            self.seen += ESCAPE.sub("", os.read(self._master, 4096).decode(errors="replace"))

    def end(self) -> int:
        return self.process.wait(timeout=60)

    def close(self) -> None:
        self.process.close()
        os.close(self._master)
        os.close(self.slave)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "rig.toml").write_text(
        'default_bench = "sim"\n[catalog]\npath = "catalog"\n[camera]\nwidth = 320\nheight = 240\n'
        "[view]\nroi = [40, 0, 240, 240]\n",
        encoding="utf-8",
    )
    return tmp_path


@pytest.fixture
def keyboard(folder):
    """Return a terminal in which an enrollment has stored its second view and stands still."""
    keyboard = Keyboard(folder, "enroll", "dice", "--views", "8")
    keyboard.until("p: pause")
    keyboard.process.wait_until_stopped()
    yield keyboard
    keyboard.close()


def test_key_pauses_and_resumes_and_the_terminal_is_restored(keyboard):
    keyboard.type(" ")
    keyboard.process.send_signal(signal.SIGCONT)
    keyboard.until("Paused. The table holds its angle.")
    assert "8 views enrolled" not in keyboard.seen
    keyboard.until("p: resume, Ctrl+C: stop")
    before = len(keyboard.seen)
    keyboard.type("xyzp")
    keyboard.until("8 views enrolled")
    assert keyboard.end() == 0
    assert "p: pause" in keyboard.seen[before:]  # again
    assert termios.tcgetattr(keyboard.slave) == keyboard.before


def test_ctrl_c_during_a_pause_stores_the_views_and_prints_how_to_continue(keyboard):
    keyboard.type("p")
    keyboard.process.send_signal(signal.SIGCONT)
    keyboard.until("Paused")
    keyboard.process.send_signal(signal.SIGINT)
    keyboard.until("rig enroll dice --resume")
    assert keyboard.end() == 130
    assert termios.tcgetattr(keyboard.slave) == keyboard.before


def test_pause_notices_a_signal_that_came_just_before_it_waits_for_a_key(monkeypatch):
    master, slave = pty.openpty()
    waits: list[float | None] = []
    really_select, really_read = select.select, os.read

    def wait(files, writable, failed, seconds=None):
        waits.append(seconds)
        if len(waits) > 6:
            raise KeyboardInterrupt  # the handler runs after a wait
        return really_select(files, writable, failed, 0)

    def read(file, size):
        assert really_select([file], [], [], 0)[0], "it would wait for ever"
        return really_read(file, size)

    with os.fdopen(slave) as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        with Pause(keys=True) as pause, pytest.raises(KeyboardInterrupt):
            os.write(master, b"p")
            monkeypatch.setattr(select, "select", wait)
            monkeypatch.setattr(os, "read", read)
            pause.point(lambda _: None)
        monkeypatch.undo()
    os.close(master)
    assert max(seconds for seconds in waits if seconds is not None) <= 0.5
    assert None not in waits


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


def test_skipped_objects_are_reported():
    console = screen(80, terminal=False)
    text = shown(console, EnrollView(console, load_config()), [Item(1, 2, "mug", "skip", SkipReason.ALREADY_ENROLLED)])
    assert text == "1 of 2  mug: skipped, it is already enrolled\n"
