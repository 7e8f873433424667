"""What every command shares: the common options, and how errors leave the program.

Nothing here imports numpy, cv2, scipy or sqlalchemy: `rig --help` must be instant.
"""

import functools
import inspect
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.ui.complete import bench_names
from rig.cli.ui.settings import Settings
from rig.core.errors import RigError

if TYPE_CHECKING:
    pass

EXIT_INTERRUPTED = 130
EXIT_BY_SIGNAL = 128  # plus the signal's number, as shells do

BenchOption = Annotated[
    str | None,
    typer.Option(
        "--bench",
        metavar="NAME",
        help="Bench to work on: hardware, sim, or a plug-in's.",
        autocompletion=bench_names,
    ),
]
ConfigOption = Annotated[Path | None, typer.Option("--config", metavar="FILE", help="Configuration (rig.toml).")]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override one setting, e.g. identify.max_views=4. Repeatable."),
]
SeedOption = Annotated[int | None, typer.Option("--seed", min=0, help="Seed of a simulated bench.")]
NoColorOption = Annotated[bool, typer.Option("--no-color", help="No colours; so does NO_COLOR in the environment.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON on stdout; text for people goes to stderr.")]


def command(function: Callable[..., None]) -> Callable[..., None]:
    """Make a command of a function whose first parameter is the `Settings`.

    The common options are added to its own; errors of the registry are printed with their next step and become the exit
    code; Ctrl+C, SIGTERM and a lost terminal unwind the stack, so that everything that is open is closed (torque off),
    and then end it.
    """
    signature = inspect.signature(function, eval_str=True)
    own = list(signature.parameters.values())[1:]
    shared = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
        for name, default, annotation in (
            ("bench", None, BenchOption),
            ("config", None, ConfigOption),
            ("overrides", None, SetOption),
            ("seed", None, SeedOption),
            ("json_", False, JsonOption),
            ("no_color", False, NoColorOption),
        )
    ]
    context = inspect.Parameter("ctx", inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=typer.Context)

    @functools.wraps(function)
    def run(ctx: typer.Context, **values: Any) -> None:
        given = [values.pop(name) for name in ("bench", "config", "overrides", "seed", "json_")]
        settings = (ctx.obj or Settings()).merged(*given)
        if values.pop("no_color"):
            without_color()
        for number in (signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is signal.SIG_DFL:  # nohup has a hang-up ignored; so be it
                signal.signal(number, _terminate)
        try:
            function(settings, **values)
        except RigError as error:
            show_error(error, settings)
            raise typer.Exit(error.exit_code) from None
        except BrokenPipeError:  # the reader, such as head, has seen enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(EXIT_BY_SIGNAL + signal.SIGPIPE) from None
        except KeyboardInterrupt:
            print("Interrupted; a table that was in use is let go, its torque off.", file=sys.stderr)
            raise typer.Exit(EXIT_INTERRUPTED) from None

    run.__signature__ = inspect.Signature([context, *own, *shared])  # type: ignore[attr-defined]
    # Typer reads the annotations beside the signature; those of the wrapped function would hide the added ones.
    run.__annotations__ = {p.name: p.annotation for p in [context, *own, *shared]}
    return run


def without_color() -> None:
    """Have everything that is printed from now on, by this program and those it starts, come without colours."""
    os.environ["NO_COLOR"] = "1"


def show_error(error: RigError, settings: Settings) -> None:
    """Print what happened, the evidence, and the next step; never a traceback."""
    if settings.json:
        settings.print_json(error.as_dict())
    lines = [f"Error {error.code} ({error.title}): {error.what}"]
    for key, value in error.evidence.items():
        if isinstance(value, list | tuple):
            lines += [f"  {key}:", *(f"    {item}" for item in value)]
        else:
            lines.append(f"  {key}: {value}")
    lines += [f"  {note}" for note in getattr(error, "__notes__", ())]
    print("\n".join([*lines, f"Next step: {error.next_step}"]), file=sys.stderr)


def _terminate(number: int, _frame: object) -> None:
    raise SystemExit(EXIT_BY_SIGNAL + number)
