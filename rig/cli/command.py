"""What every command shares: the common options, and how errors leave the program.

Nothing here imports numpy, cv2, scipy or sqlalchemy: `rig --help` must be instant.
"""

import functools
import inspect
import json
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.complete import bench_names
from rig.errors import RigError

if TYPE_CHECKING:
    from rig.bench import Bench
    from rig.catalog import Catalog
    from rig.clock import Clock
    from rig.config import RigConfig

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


@dataclass(frozen=True)
class Settings:
    """The common options, as given before and after the subcommand."""

    bench: str | None = None
    config: Path | None = None
    overrides: tuple[str, ...] = ()
    seed: int | None = None
    json: bool = False
    _loaded: dict[str, "RigConfig"] = field(default_factory=dict, repr=False, compare=False)

    def merged(
        self, bench: str | None, config: Path | None, overrides: list[str] | None, seed: int | None, json: bool
    ) -> "Settings":
        """Return these settings with those that follow the subcommand, which win."""
        return replace(
            self,
            bench=bench or self.bench,
            config=config or self.config,
            overrides=(*self.overrides, *(overrides or ())),
            seed=self.seed if seed is None else seed,
            json=json or self.json,
            _loaded={},
        )

    def load(self) -> "RigConfig":
        """Return the configuration in force."""
        if "config" not in self._loaded:
            from rig.config import load_config

            self._loaded["config"] = load_config(self.config, self.overrides)
        return self._loaded["config"]

    def arguments(self) -> list[str]:
        """Return the words that give these settings to another command."""
        words = [] if self.bench is None else ["--bench", self.bench]
        words += [] if self.config is None else ["--config", str(self.config)]
        words += [word for override in self.overrides for word in ("--set", override)]
        return words if self.seed is None else [*words, "--seed", str(self.seed)]

    @property
    def bench_name(self) -> str:
        return self.bench or self.load().default_bench

    def open_bench(self, *, tell: bool = True) -> "Bench":
        """Open the bench and say what a person should know of it, unless the command does so itself (``tell``)."""
        from rig.bench import open_bench

        bench = open_bench(self.bench_name, self.load(), seed=self.seed)
        # Before anything moves.
        for finding in (*bench.safety.findings, *(bench.out_of_force if tell else ())):
            print(f"Note: {finding}.", file=sys.stderr)
        return bench

    def open_catalog(self, *, clock: "Clock | None" = None, create: bool = False, read_only: bool = False) -> "Catalog":
        """Open the bench's catalog; to add views to it takes the ``clock`` that they were captured by, the bench's."""
        from rig.catalog import Catalog
        from rig.clock import SystemClock

        path = self.load().catalog_path(self.bench_name)
        return Catalog.open(path, clock=clock or SystemClock(), create=create, read_only=read_only)

    def catalog_there(self) -> "Catalog | None":
        """Return the bench's catalog, to be read and closed; None where none was made yet."""
        path = self.load().catalog_path(self.bench_name)
        return self.open_catalog(read_only=True) if (path / "catalog.sqlite").exists() else None

    def note(self, action: str, **details: Any) -> None:
        """Write into the log of the bench's catalog, where there is one, what was done with the bench (`rig log`)."""
        path = self.load().catalog_path(self.bench_name)
        if not (path / "catalog.sqlite").exists():
            return
        try:
            with self.open_catalog() as catalog:
                catalog.note(action, **details)
        except RigError as error:  # what was done was done
            print(f"Note: this is not in the log: {error.what}.", file=sys.stderr)

    def say(self, text: str, data: Any) -> None:
        """Print ``text`` for people, or ``data`` as one line of JSON."""
        if self.json:
            self.print_json(data)
        else:
            print(text, flush=True)

    def print_json(self, value: Any) -> None:
        """Print one line of JSON on stdout, at once."""
        print(json.dumps(value, ensure_ascii=False, allow_nan=False, default=str), flush=True)


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
