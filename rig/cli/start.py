"""The start of the program `rig`: Ctrl+C ends it without a traceback at any moment, also while it imports its modules.

No other module imports this one, and it imports only what Python has built in. The module `signal` would import `enum`
and others, and Ctrl+C meanwhile would end in a traceback.
"""

import _signal  # type: ignore[import-not-found]
import os
import sys


def main() -> None:
    """Run the command line. A SIGINT that is ignored stays ignored until a command begins."""
    if _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler:
        _signal.signal(_signal.SIGINT, _leave)
    from rig.cli.main import main as run
    from rig.cli.ui.exit_codes import EXIT_INTERRUPTED

    try:
        try:
            run()
        finally:
            _signal.signal(_signal.SIGINT, _signal.SIG_IGN)  # the interpreter ends now: the exit code stands
    except KeyboardInterrupt:
        sys.exit(EXIT_INTERRUPTED)


def _leave(number: int, _frame: object) -> None:
    """End at once: before a command begins, nothing is open that must be closed."""
    os._exit(128 + number)
