"""The person who brings the objects of a tray, asked on the terminal."""

import sys
from collections.abc import Callable
from typing import TextIO

from rig.catalog import ObjectSummary
from rig.core.errors import RigError, UsageError
from rig.plans.tray import TrayDecision, TrayItem

BELL = "\a"


class OperatorPrompts:
    """Asks for the next object, with a beep, and reads the answer as a line.

    Parameters
    ----------
    before
        Called before a question: takes what is live off the screen.
    questions, answers
        Standard error and standard input by default. The end of the answers means stop.
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

    def request(self, item: TrayItem, number: int, of: int, kept: ObjectSummary | None) -> TrayDecision:
        label = f" ({item.label})" if item.label else ""
        asked = f"{number} of {of}: put {item.name}{label} on the table and take your hands away."
        if kept is None:
            return self._ask(
                asked, {"": TrayDecision.PROCEED, "s": TrayDecision.SKIP, "q": TrayDecision.STOP}, "Enter goes on"
            )
        views = kept.unfinished_views or 0
        return self._ask(
            f"{number} of {of}: {item.name} has {views} view{'' if views == 1 else 's'} from before. "
            "If nobody has moved it since, it can go on.",
            {"": TrayDecision.PROCEED, "n": TrayDecision.RESTART, "s": TrayDecision.SKIP, "q": TrayDecision.STOP},
            "Enter goes on, n begins anew because it was moved",
        )

    def decide_after_error(self, item: TrayItem, error: RigError) -> TrayDecision:
        return self._ask(
            f"{item.name}: {error.what}\n{error.next_step}",
            {"": TrayDecision.PROCEED, "s": TrayDecision.SKIP, "q": TrayDecision.STOP},
            "Enter tries again",
        )

    def _ask(self, question: str, answers: dict[str, TrayDecision], hint: str) -> TrayDecision:
        self._before()
        bell = BELL if self._questions.isatty() else ""
        while True:
            print(f"{bell}{question}\n  {hint}, s leaves it out, q stops: ", end="", file=self._questions, flush=True)
            try:
                said = self._answers.readline()
            except (OSError, UnicodeDecodeError) as error:
                raise UsageError(
                    "Nobody can be asked for the next object.", next_step="Run the command in a terminal."
                ) from error
            if not said:
                print(file=self._questions)
                return TrayDecision.STOP
            if (answer := answers.get(said.strip().lower())) is not None:
                return answer
