"""The operator of a job: its questions, and who answers them.

The terminal (`rig.cli.ui.prompts`), the browser (`rig.web.work`) and `Unattended` implement `Operator`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

from rig.core.next_steps import SomeSteps


class Choice(StrEnum):
    """The answers of the operator."""

    CONTINUE = "continue"
    RESTART = "restart"
    KEEP = "keep"
    SKIP = "skip"
    STOP = "stop"


class Subject(StrEnum):
    """What a question is about."""

    OBJECT = "object"
    """The next object must come onto the table."""
    UNFINISHED = "unfinished"
    """The next object has an interrupted enrollment."""
    FAILURE = "failure"
    """An object could not be enrolled."""
    EMPTY_TABLE = "empty-table"
    """The table must be empty for its image."""
    LONG_WAY = "long-way"
    """The table would rotate by more than half a revolution."""
    REVOLUTION = "revolution"
    """The home mark shows the table's angle, but not by how many revolutions the cable is wound up."""
    CALIBRATION = "calibration"
    """A step of a calibration needs the operator."""


@dataclass(frozen=True, slots=True)
class Question:
    """A question to the operator."""

    subject: Subject
    text: str
    """What to do, as sentences."""
    choices: Mapping[Choice, str] = field(default_factory=lambda: {Choice.CONTINUE: "continue", Choice.STOP: "stop"})
    """The possible answers, with what each one does."""
    default: Choice = Choice.CONTINUE
    """The answer of the key Enter."""
    unattended: Choice = Choice.CONTINUE
    """The answer if there is no operator."""
    steps: SomeSteps = ()
    """What is to be done before the answer, as the next step of an error."""


class Operator(Protocol):
    """An operator: answers the questions of a job."""

    @property
    def is_there(self) -> bool:
        """Whether a person can answer, so that it is useful to ask."""
        ...

    def choose(self, question: Question) -> Choice:
        """Wait for the answer to a question, and return it."""
        ...

    def ask_sample(self) -> str | None:
        """Wait until the sample on the table is scanned or typed; None if it has no name."""
        ...


class Unattended:
    """No operator: each question has the answer that is right without one, for example on a bench with a robot."""

    is_there = False

    def choose(self, question: Question) -> Choice:
        return question.unattended

    def ask_sample(self) -> str | None:
        return None
