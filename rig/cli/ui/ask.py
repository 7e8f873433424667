"""Questions to the person at the terminal, or to the file that answers for them."""

import sys
from collections.abc import Callable, Sequence
from typing import TypeVar

from rig.core.errors import UsageError

T = TypeVar("T")


def line(question: str) -> str:
    """Ask on stderr and return the line that was answered; Ctrl+C is passed on.

    Raises
    ------
    UsageError
        The answers have come to their end.
    """
    print(question, end=" ", file=sys.stderr, flush=True)
    answer = sys.stdin.readline()
    if not sys.stdin.isatty():
        print(answer.strip(), file=sys.stderr)  # so that a log reads as the dialogue was
    if not answer:
        raise UsageError("Nobody answered the question.", next_step="Give --yes, or run it in a terminal.")
    return answer.strip()


def agreed(question: str, *, default: bool = False) -> bool:
    """Ask a question for yes or no; Enter takes the default."""
    while True:
        answer = line(f"{question} [{'Y/n' if default else 'y/N'}]").lower()
        if answer in ("", "y", "yes", "n", "no"):
            return answer[0] == "y" if answer else default
        print("Answer y or n.", file=sys.stderr)


def chosen(question: str, options: Sequence[str], *, other: str = "") -> int | None:
    """Return the index of the option that was chosen, None for ``other`` (told as ``o``)."""
    print(question, file=sys.stderr)
    for number, option in enumerate(options, start=1):
        print(f"  {number}  {option}", file=sys.stderr)
    if other:
        print(f"  o  {other}", file=sys.stderr)
    while True:
        answer = line(f"1..{len(options)}{' or o' if other else ''}:").lower()
        if answer.isdigit() and 1 <= int(answer) <= len(options):
            return int(answer) - 1
        if answer == "o" and other:
            return None
        print("Answer with one of the numbers.", file=sys.stderr)


def entered(question: str, default: T, parse: Callable[[str], T]) -> T:
    """Ask for a value until it can be read; Enter takes the default."""
    while True:
        answer = line(f"{question} [{default}]")
        if not answer:
            return default
        try:
            return parse(answer)
        except ValueError as error:
            print(f"That cannot be: {error}", file=sys.stderr)
