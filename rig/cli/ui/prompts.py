"""Questions to the operator at the terminal; a file or a pipe on standard input can answer them, too."""

import sys
from collections.abc import Callable, Sequence
from typing import TypeVar

from rig.core.errors import UsageError
from rig.core.phrases import whole

T = TypeVar("T")


def ask_sample() -> str | None:
    """Ask for the sample on the table until it is valid text; None if the operator gives none.

    A barcode scanner that acts as a keyboard answers, too: it types the code and presses Enter.
    """
    from rig.catalog.results import clean_text

    while True:
        answer = ask_line("Sample (scan or type it; Enter for none):", otherwise="give --sample")
        try:
            return clean_text(answer, "sample") if answer else None
        except UsageError as error:
            print(f"{error.what} {error.next_step}", file=sys.stderr)


def ask_line(question: str, *, otherwise: str = "add --yes") -> str:
    """Print a question on stderr and return the line that answers it; Ctrl+C is passed on.

    Raises
    ------
    UsageError
        Standard input has ended.
    """
    print(question, end=" ", file=sys.stderr, flush=True)
    answer = sys.stdin.readline()
    if not sys.stdin.isatty():
        print(answer.strip(), file=sys.stderr)  # a log then shows the answers, too
    if not answer:
        raise UsageError(
            "The question was not answered: standard input has ended.",
            next_step=f"Run the command in a terminal, or {otherwise}.",
        )
    return answer.strip()


def ask_yes_no(question: str, *, default: bool = False) -> bool:
    """Ask for yes or no; Enter takes the default."""
    while True:
        answer = ask_line(f"{question} [{'Y/n' if default else 'y/N'}]").lower()
        if answer in ("", "y", "yes", "n", "no"):
            return answer[0] == "y" if answer else default
        print("Answer y or n.", file=sys.stderr)


def ask_choice(question: str, options: Sequence[str], *, other: str = "") -> int | None:
    """Return the index of the chosen option; None for ``other``, which the operator chooses with ``o``."""
    print(question, file=sys.stderr)
    for number, option in enumerate(options, start=1):
        print(f"  {number}  {option}", file=sys.stderr)
    if other:
        print(f"  o  {other}", file=sys.stderr)
    while True:
        answer = ask_line(f"1–{len(options)}{' or o' if other else ''}:").lower()
        if (chosen := whole(answer)) is not None and 1 <= chosen <= len(options):
            return chosen - 1
        if answer == "o" and other:
            return None
        print(f"Answer with a number from 1 to {len(options)}{', or with o' if other else ''}.", file=sys.stderr)


def ask_value(question: str, default: T, parse: Callable[[str], T]) -> T:
    """Ask for a value until ``parse`` accepts it; Enter takes the default.

    ``parse`` raises `ValueError` with a sentence for the operator, such as "'abc' is not a number."
    """
    while True:
        answer = ask_line(f"{question} [{default}]")
        if not answer:
            return default
        try:
            return parse(answer)
        except ValueError as error:
            print(error, file=sys.stderr)
