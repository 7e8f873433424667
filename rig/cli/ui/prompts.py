"""Questions to the operator at the terminal; a file or a pipe on standard input can answer them, too."""

import sys
from collections.abc import Callable
from typing import Final

import typer

from rig.cli.ui.exit_codes import EXIT_DECLINED
from rig.cli.ui.settings import Settings
from rig.cli.ui.terminal import unguarded
from rig.core.errors import UsageError
from rig.core.next_steps import in_words
from rig.plans.operator import Choice, Question

BELL: Final = "\a"
_KEYS: Final = {Choice.CONTINUE: "y", Choice.RESTART: "n", Choice.KEEP: "k", Choice.SKIP: "s", Choice.STOP: "q"}


class TerminalOperator:
    """Asks the questions of a job at the terminal, with a beep.

    ``is_there`` says whether a person reads the questions. ``before`` is called before each question: it removes the
    live display.
    """

    def __init__(self, *, is_there: bool = True, before: Callable[[], None] = lambda: None) -> None:
        self.is_there = is_there
        self._before = before

    def choose(self, question: Question) -> Choice:
        self._before()
        keys = {"" if choice is question.default else _KEYS[choice]: choice for choice in question.choices}
        hints = ", ".join(f"{key or 'Enter'}: {question.choices[choice]}" for key, choice in keys.items())
        words = "\n".join(filter(None, (question.text, in_words(question.steps))))
        text = f"{words}\n  {hints}"
        # At the end of the input, a question is answered with its last choice, unless Enter would stop the job.
        ask = ask_line if question.default is Choice.STOP else read_answer
        while True:
            if sys.stderr.isatty():
                unguarded(sys.stderr).write(BELL)
            answer = ask(text)
            if answer is None:
                return list(question.choices)[-1]
            if (choice := keys.get(answer.lower())) is not None:
                return choice

    def ask_sample(self) -> str | None:
        """Ask until the sample is valid text; a barcode scanner answers, too: it types the code and presses Enter."""
        from rig.catalog.results import clean_text

        while True:
            answer = ask_line("Sample (scan or type it; Enter for none):", otherwise="give --sample")
            try:
                return clean_text(answer, "sample") if answer else None
            except UsageError as error:
                print(f"{error.what} {error.next_step}", file=sys.stderr)


def read_answer(question: str) -> str | None:
    """Print a question on stderr and return the line that answers it; None if standard input has ended.

    Raises `UsageError`: standard input cannot be read.
    """
    print(question, end=" ", file=sys.stderr, flush=True)
    try:
        answer = sys.stdin.readline()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(
            "The program cannot ask: standard input is not readable.", next_step="Run the command in a terminal."
        ) from error
    if not sys.stdin.isatty():
        print(answer.strip(), file=sys.stderr)  # a log then shows the answers, too
    return answer.strip() if answer else None


def ask_line(question: str, *, otherwise: str = "add --yes") -> str:
    """Return the answer to a question; Ctrl+C is passed on. Raises `UsageError` if standard input has ended."""
    answer = read_answer(question)
    if answer is None:
        raise UsageError(
            "The question was not answered: standard input has ended.",
            next_step=f"Run the command in a terminal, or {otherwise}.",
        )
    return answer


def is_interactive() -> bool:
    """Return whether an operator can answer questions: standard input is a terminal."""
    return sys.stdin.isatty()


def confirm(question: str, *, yes: bool, settings: Settings) -> None:
    """Ask for yes or no before a deletion or another change; Enter means no.

    Raises `UsageError`: there is no terminal to ask on, and ``yes`` is not set.
    """
    if yes:
        return
    if settings.json or not is_interactive():
        raise UsageError(f"{question} This needs a confirmation.", next_step="Add --yes to confirm.")
    while (answer := ask_line(f"{question} [y/N]").lower()) not in ("", "y", "yes", "n", "no"):
        print("Answer y or n.", file=sys.stderr)
    if not answer.startswith("y"):
        print("Nothing was changed.", file=sys.stderr)
        raise typer.Exit(EXIT_DECLINED)
