"""Prompts for the operator who puts the objects of a tray on the table."""

import sys
from collections.abc import Callable
from typing import Final, TextIO

from rig.catalog import ObjectSummary
from rig.cli.ui.terminal import unguarded
from rig.core.errors import RigError, UsageError
from rig.plans.tray import TrayDecision, TrayItem

BELL: Final = "\a"
_KEYS: Final = {"": TrayDecision.PROCEED, "s": TrayDecision.SKIP, "q": TrayDecision.STOP}


class OperatorPrompts:
    """Asks for each object of a tray on the terminal, with a beep.

    Parameters
    ----------
    before
        Called before each question: removes the live display.
    questions, answers
        Standard error and standard input by default. The end of the input means stop.
    """

    def __init__(
        self,
        before: Callable[[], None] = lambda: None,
        *,
        questions: TextIO | None = None,
        answers: TextIO | None = None,
    ) -> None:
        self._before = before
        self._questions = questions or sys.stderr
        self._answers = answers or sys.stdin

    def request(self, item: TrayItem, number: int, of: int, interrupted: ObjectSummary | None) -> TrayDecision:
        label = f" ({item.label})" if item.label else ""
        if interrupted is None:
            return self._ask(
                f"{number} of {of}: put {item.name}{label} on the table and take your hands away.",
                _KEYS,
                "Enter: continue",
            )
        views = interrupted.unfinished_views or 0
        return self._ask(
            f"{number} of {of}: {item.name} has {views} view{'' if views == 1 else 's'} of an interrupted enrollment. "
            "You can resume it if the object was not moved.",
            {**_KEYS, "n": TrayDecision.RESTART},
            "Enter: resume, n: enroll again because the object was moved",
        )

    def decide_after_error(self, item: TrayItem, error: RigError) -> TrayDecision:
        return self._ask(f"{item.name}: {error.what}\n{error.next_step}", _KEYS, "Enter: try again")

    def _ask(self, question: str, keys: dict[str, TrayDecision], hint: str) -> TrayDecision:
        self._before()
        while True:
            if self._questions.isatty():
                unguarded(self._questions).write(BELL)
            print(f"{question}\n  {hint}, s: skip, q: stop ", end="", file=self._questions, flush=True)
            try:
                answer = self._answers.readline()
            except (OSError, UnicodeDecodeError) as error:
                raise UsageError(
                    "The program cannot ask for the next object: standard input is not readable.",
                    next_step="Run the command in a terminal.",
                ) from error
            if not answer:
                print(file=self._questions)
                return TrayDecision.STOP
            if (decision := keys.get(answer.strip().lower())) is not None:
                return decision
