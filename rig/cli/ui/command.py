"""The frame of every command: common options, errors and signals.

This module imports none of numpy, cv2, scipy and sqlalchemy: `rig --help` must start at once.
"""

import errno
import functools
import inspect
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import typer

from rig.cli.ui.exit_codes import EXIT_INTERRUPTED
from rig.cli.ui.options import CommonOptions, options_of, show_parameters, spread
from rig.cli.ui.settings import Settings
from rig.cli.ui.terminal import discard, guarded_output
from rig.core.errors import OutputFailed, RigError, UsageError
from rig.core.next_steps import for_bench, in_words
from rig.core.signals import EXIT_BY_SIGNAL, handle_signals


def command(function: Callable[..., None]) -> Callable[..., None]:
    """Turn a function whose first parameter is `Settings` into a command.

    The command also takes the common options. It prints an error of the registry with its next step and exits with the
    error's exit code. Ctrl+C and every other signal that can be handled unwind the stack, so that every open device is
    closed (torque off) before the program ends; see `rig.core.signals`.
    """
    _, *own = spread(function)
    context = inspect.Parameter("ctx", inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=typer.Context)

    @functools.wraps(function)
    def run(ctx: typer.Context, **values: Any) -> None:
        given = {name: values.pop(name) for name in CommonOptions.__annotations__}
        settings = (ctx.obj or Settings()).merged(**given)
        handle_signals()
        try:
            with guarded_output():
                try:
                    try:
                        function(settings, **values)
                    except OSError as error:  # every question about such a file raises it
                        if error.errno != errno.ENAMETOOLONG:
                            raise
                        raise UsageError("The name of a file is too long.", next_step="Give a shorter path.") from error
                    sys.stdout.flush()
                except RigError as error:
                    show_error(error, settings)
                    raise typer.Exit(error.exit_code) from None
                except RuntimeError as error:  # Python 3.11 makes it of a signal in __set_name__, as in many imports
                    if isinstance(error.__cause__, KeyboardInterrupt | SystemExit):
                        raise error.__cause__ from None
                    raise
        except BrokenPipeError:  # the reader of a pipe, such as head, has ended
            discard(sys.stdout)
            raise typer.Exit(EXIT_BY_SIGNAL + signal.SIGPIPE) from None
        except KeyboardInterrupt:
            torque = " If the command has moved the table, its torque is off now." if settings.opened else ""
            print(f"Interrupted.{torque}", file=sys.stderr)
            raise typer.Exit(EXIT_INTERRUPTED) from None

    show_parameters(run, [context, *own, *options_of(CommonOptions)])
    return run


class Group(typer.Typer):
    """Commands below one name; each takes `Settings` and the common options, as by `command`."""

    def __init__(self, help: str | None) -> None:
        super().__init__(help=help, no_args_is_help=True)

    def command(self, name: str | None = None, **extra: Any) -> Callable[[Any], Any]:
        register = super().command(name, **extra)
        return lambda function: register(command(function))


def show_error(error: RigError, settings: Settings) -> None:
    """Print an error with its evidence and its next step, with commands for the same bench, without a traceback."""
    if settings.json:
        with suppress(OutputFailed):
            settings.print_json(error.problem)
    lines = [f"Error {error.code} ({error.title}): {error.what}"]
    for key, value in error.evidence.items():
        if isinstance(value, list | tuple):
            lines += value and [f"  {key}:", *(f"    {item}" for item in value)]
        else:
            lines.append(f"  {key}: {value}")
    lines += [f"  {note}" for note in getattr(error, "__notes__", ())]
    with suppress(OutputFailed):
        step = in_words(for_bench(error.steps, settings.selection()))
        print("\n".join([*lines, f"Next step: {step}"]), file=sys.stderr)
