"""What a program tells beside its work: to a command of the user, and as a note on stderr."""

import json
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, Final

from rig.core.control_characters import neutral
from rig.core.json_form import plain

LIMIT_S: Final = 30.0
"""A command that takes longer is killed: it may wait for a network that is gone."""
_last: list[threading.Thread] = []
"""The thread of the last command."""


def notify(command: Sequence[str], message: Mapping[str, Any]) -> None:
    """Run a command with a message as JSON on its stdin, beside the bench: this returns at once.

    Commands run one after the other, in the order of the calls. The program ends when the last one has ended, each
    after `LIMIT_S` at most. If a command fails, a warning is printed.
    """
    if command:
        content = json.dumps(plain(message), ensure_ascii=False, default=str) + "\n"
        _last[:] = [threading.Thread(target=_run, args=(list(command), content, *_last), name="notify")]
        _last[0].start()


def notify_of_job(command: Sequence[str], bench: str, kind: str, words: str, job: Mapping[str, Any]) -> None:
    """Tell a command how a job ended. The first line of ``words`` is the answer, or the reason of a failure."""
    text = f"{bench}: {kind} {job['state']}. {words}".partition("\n")[0].strip()
    notify(command, {"event": "job", "bench": bench, "text": text, "job": job})


def print_note(text: str) -> None:
    """Print a note on stderr, from any thread, unless it is closed."""
    with suppress(OSError):
        print(f"Note: {text}", file=sys.stderr, flush=True)


def _run(command: list[str], content: str, before: threading.Thread | None = None) -> None:
    if before is not None:
        before.join()
    try:
        # In a session of its own, so that Ctrl+C at the terminal does not end it.
        ended = subprocess.run(
            command,
            input=content.encode(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            timeout=LIMIT_S,
            start_new_session=True,
            check=False,
        )
    except subprocess.TimeoutExpired:
        problem = f"it took more than {LIMIT_S:g} s"
    except OSError as error:
        problem = error.strerror or str(error)
    else:
        if ended.returncode == 0:
            return
        problem = f"exit code {ended.returncode}. {ended.stderr.decode(errors='replace').strip()[-300:]}".strip()
    with suppress(OSError, ValueError):  # stderr is closed
        text = f"Warning: notify_command ({command[0]}) failed: {problem}. Next step: run it in a terminal."
        print(neutral(text), file=sys.stderr, flush=True)
