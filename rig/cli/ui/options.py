"""Options that several commands share, and their values."""

import inspect
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypedDict, get_args, get_type_hints

import typer

from rig.core.errors import UsageError, os_errors_as


class CommonOptions(TypedDict):
    """The options of every command, given before or after it."""

    bench: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Bench to use: hardware, sim, sim-bench or the bench of a plug-in (default: default_bench).",
        ),
    ]
    config: Annotated[Path | None, typer.Option(metavar="FILE", help="Configuration file (default: rig.toml).")]
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="Replace one setting, for example identify.max_views=4. Repeatable."
        ),
    ]
    seed: Annotated[int | None, typer.Option(min=0, metavar="N", help="Seed of the simulated bench.")]
    json: Annotated[bool, typer.Option("--json", help="Print JSON on stdout and text on stderr.")]
    no_color: Annotated[bool, typer.Option("--no-color", help="Print without colours, as with NO_COLOR=1.")]


YesOption = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask for confirmation.")]
JobsOption = Annotated[int | None, typer.Option(min=1, help="Number of processes (default: one per core).")]


def spread(function: Callable[..., Any]) -> list[inspect.Parameter]:
    """Return the parameters of a command; each field of ``**values: Unpack[TypedDict]`` becomes an option."""
    found: list[inspect.Parameter] = []
    for parameter in inspect.signature(function, eval_str=True).parameters.values():
        is_bundle = parameter.kind is inspect.Parameter.VAR_KEYWORD
        found += options_of(*get_args(parameter.annotation)) if is_bundle else [parameter]
    return found


@cache
def options_of(bundle: type) -> tuple[inspect.Parameter, ...]:
    """Return the fields of a `TypedDict` as options; one that is not given is False or None."""
    return tuple(
        inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, default=False if get_args(kind)[0] is bool else None, annotation=kind
        )
        for name, kind in get_type_hints(bundle, include_extras=True).items()
    )


def show_parameters(command: Callable[..., Any], parameters: Sequence[inspect.Parameter]) -> None:
    """Let Typer take these parameters for those of a command: it reads the signature and the annotations."""
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {one.name: one.annotation for one in parameters}


def check_new(file: Path, suffix: str) -> None:
    """Raise `UsageError` if a file has another suffix, or exists."""
    if file.suffix.lower() != suffix:
        raise UsageError(f"{file} does not end with {suffix}.", next_step=f"Give a name that ends with {suffix}.")
    if file.exists():
        raise UsageError(f"{file} exists.", next_step="Give another name.")


def write_new(file: Path, content: bytes) -> None:
    """Write a file that does not exist yet. Raises `UsageError` if that is not possible."""
    what, step = f"{file} cannot be written.", "Choose another folder."
    with os_errors_as(UsageError, what, next_step=step), file.open("xb") as output:
        output.write(content)
