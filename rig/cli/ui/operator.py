"""The operator at the terminal."""

import sys
from collections.abc import Callable
from typing import Final, TextIO

from rig.cli.ui import prompts
from rig.cli.ui.terminal import unguarded
from rig.core.errors import UsageError
from rig.core.next_steps import in_words
from rig.plans.operator import Choice, Question

BELL: Final = "\a"
_KEYS: Final = {
    Choice.CONTINUE: "y",
    Choice.RESTART: "n",
    Choice.KEEP: "k",
    Choice.SKIP: "s",
    Choice.STOP: "q",
}


class TerminalOperator:
    """Asks questions at the terminal, with a beep.

    Parameters
    ----------
    is_there
        Whether a person reads the questions.
    before
        Called before each question: removes the live display.
    questions, answers
        Standard error and standard input by default. The end of the input is the last choice of a question.
    """

    def __init__(
        self,
        *,
        is_there: bool = True,
        before: Callable[[], None] = lambda: None,
        questions: TextIO | None = None,
        answers: TextIO | None = None,
    ) -> None:
        self.is_there = is_there
        self._before = before
        self._questions = questions or sys.stderr
        self._answers = answers or sys.stdin

    def choose(self, question: Question) -> Choice:
        self._before()
        keys = {"" if choice is question.default else _KEYS[choice]: choice for choice in question.choices}
        hints = ", ".join(f"{key or 'Enter'}: {question.choices[choice]}" for key, choice in keys.items())
        while True:
            if self._questions.isatty():
                unguarded(self._questions).write(BELL)
            text = "\n".join(filter(None, (question.text, in_words(question.steps))))
            print(f"{text}{question.picture}\n  {hints} ", end="", file=self._questions, flush=True)
            try:
                answer = self._answers.readline()
            except (OSError, UnicodeDecodeError) as error:
                raise UsageError(
                    "The program cannot ask: standard input is not readable.",
                    next_step="Run the command in a terminal.",
                ) from error
            if not answer:
                print(file=self._questions)
                if question.default is Choice.STOP:
                    raise UsageError(
                        "The question was not answered: standard input has ended.",
                        next_step="Run the command in a terminal, or add --yes.",
                    )
                return list(question.choices)[-1]
            if (choice := keys.get(answer.strip().lower())) is not None:
                return choice

    def ask_sample(self) -> str | None:
        return prompts.ask_sample()
