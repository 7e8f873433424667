"""The command line program `rig`: its commands, grouped as in its help. Each is imported when it is called."""

import ast
import re
import signal
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import copy
from functools import cache
from importlib.metadata import EntryPoint, entry_points, version
from importlib.util import find_spec
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Any, Final, Unpack, cast

import typer
from typer.core import TyperCommand, TyperGroup

from rig.cli.ui.command import show_error
from rig.cli.ui.exit_codes import EXIT_CODES
from rig.cli.ui.options import CommonOptions, show_parameters, spread
from rig.cli.ui.settings import Settings
from rig.cli.ui.terminal import checked_output, discard
from rig.core.control_characters import neutral
from rig.core.errors import OutputFailed, RigError, UsageError
from rig.core.signals import EXIT_BY_SIGNAL, handle_signals

SECTIONS: Final[dict[str, dict[str, str | None]]] = {
    "Start here": {
        "doctor": "bench.doctor:doctor",
        "empty-table": "bench.table:empty_table",
        "enroll": "objects.enroll:enroll",
        "identify": "objects.identify:identify",
        "results": "catalog.results:app",
        "catalog": "catalog.catalog:app",
        "status": "bench.status:status",
        "stop": "bench.stop:stop",
        "acknowledge": "bench.table:acknowledge",
        "serve": "bench.serve:serve",
    },
    "Saved searches and experiments": {
        "replay": "objects.runs:replay",
        "report": "objects.runs:report",
        "eval": "objects.evaluate:evaluate",
    },
    "Exchange and log": {
        "import": "catalog.exchange:import_",
        "export": "catalog.exchange:export",
        "log": "catalog.results:log",
    },
    "Table": {"home": "bench.table:home", "goto": "bench.table:goto", "jog": "bench.table:jog"},
    "Devices and settings": {
        "setup": "bench.doctor:setup",
        "find": "bench.doctor:find",
        "config": "bench.config:app",
        "calibrate": None,
        "snapshot": "bench.snapshot:snapshot",
        "servo": "bench.servo:app",
        "head": "bench.head:app",
    },
    "Simulated bench": {"demo": None, "faults": None, "sim-bench": None},
}
"""The places of the commands in `rig.cli`, by the sections and in the order of the help; None is a plug-in.

The first section is for each day.
"""
GROUP: Final = "rig.commands"
_WANTS_JSON = "rig.wants_json"
_TYPER_USAGE_ERROR: Any = typer.BadParameter.__base__
"""Typer exports no name for it, and the module of the class depends on Typer's version."""


class _Subcommands(TyperGroup):
    """The commands of a group, each with its first sentence; the help of Typer cuts it at the end of the line."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(
                [(name, self.commands[name].get_short_help_str(limit=200)) for name in self.list_commands(ctx)]
            )


@cache
def _places() -> dict[str, EntryPoint]:
    """Return the places of all commands: of our own, and of the plug-ins."""
    own = {name: f"{__package__}.{place}" for places in SECTIONS.values() for name, place in places.items() if place}
    plugins = sorted(entry_points(group=GROUP), key=lambda point: point.name)
    return {point.name: point for point in (*(EntryPoint(*one, GROUP) for one in own.items()), *plugins)}


@cache
def _built(name: str) -> Any:
    """Import a command, and return it with its options as a command of Typer."""
    point = _places()[name]
    try:
        found = point.load()
    except Exception as broken:  # the other commands work without this plug-in
        raise _TYPER_USAGE_ERROR(f"The plug-in {point.value} cannot be loaded: {broken}") from broken
    frame = typer.Typer(rich_markup_mode=None)
    if isinstance(found, typer.Typer):
        frame.add_typer(found, name=name, cls=_Subcommands)
    else:  # the angle of goto can be negative
        frame.command(name, context_settings={"ignore_unknown_options": True} if name == "goto" else None)(found)
    return typer.main.get_group(frame).commands[name]


class _Table(Mapping[str, Any]):
    """The commands by name. To import all of them takes a second, so each is imported when it is asked for."""

    def __iter__(self) -> Iterator[str]:
        return iter(_places())

    def __len__(self) -> int:
        return len(_places())

    def __getitem__(self, name: str) -> Any:
        if name not in _places():
            raise KeyError(name)
        return _built(name)


def _sentence(name: str) -> str:
    """Return the first sentence about a command: of its function, or of the module of a group. Nothing is imported."""
    point = _places()[name]
    try:
        spec = find_spec(point.module)
        tree = ast.parse(Path(spec.origin).read_text(encoding="utf-8") if spec and spec.origin else "")
    except Exception as broken:  # the help of the other commands does not need this plug-in
        return neutral(f"Cannot be loaded: {broken}.")
    functions = [one for one in tree.body if isinstance(one, ast.FunctionDef) and one.name == point.attr]
    text = ast.get_docstring(functions[0] if functions else tree)
    return neutral(re.split(r"\.\s", text or "")[0].removesuffix(".")) + "."


class _Commands(TyperGroup):
    """All commands. With ``--json`` an error in the arguments is also printed as JSON, as other errors are."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands = cast(Any, _Table())

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        wants_json = "--json" in args
        with _usage_error(json=wants_json):
            context = super().make_context(info_name, args, parent, **extra)
        context.meta[_WANTS_JSON] = wants_json
        return context

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        self.commands.get(args[0])  # Typer would add to the error of a damaged plug-in what else may be meant
        found = super().resolve_command(ctx, args)
        handle_signals()  # until here only modules were imported, and Ctrl+C ended the program at once
        return found

    def invoke(self, ctx: Any) -> Any:
        with _usage_error(json=ctx.meta[_WANTS_JSON]):
            return super().invoke(ctx)

    def shell_complete(self, ctx: Any, incomplete: str) -> Any:
        """Complete the names from their texts alone."""
        ctx.command = named = copy(self)
        named.commands = {name: TyperCommand(name, help=_sentence(name)) for name in self.commands}
        return super(_Commands, named).shell_complete(ctx, incomplete)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the commands in their sections, and then the options; the help of Typer begins with the options."""
        named = {name for names in SECTIONS.values() for name in names}
        groups = {**SECTIONS, "Plug-ins": [name for name in self.commands if name not in named]}
        sections = {title: [(neutral(name), _sentence(name)) for name in names] for title, names in groups.items()}
        options: Any = self.get_params(ctx)
        sections["Options"] = [
            (f"{', '.join(sorted(one.opts))} {one.metavar or ''}".rstrip(), one.help) for one in options
        ]
        formatter.write(f"{self.get_usage(ctx)}\n\n{self.help}\n")
        for title, rows in sections.items():
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)
        formatter.write(f"\n{self.epilog}\n")


@contextmanager
def _usage_error(*, json: bool) -> Iterator[None]:
    """Neutralise an error in the arguments, and print it as JSON; Typer prints it as text."""
    try:
        yield
    except _TYPER_USAGE_ERROR as error:
        error.message = neutral(error.message.removeprefix("Value error, "))  # Pydantic's words
        if json and type(error).__name__ != "NoArgsIsHelpError":
            path = error.ctx.command_path if error.ctx else "rig"
            problem = UsageError(error.format_message(), next_step=f"For the arguments: {path} --help")
            Settings().print_json(problem.problem)
        if error.ctx is None and hasattr(error, "option_name"):  # one without its value: Typer shows no usage then
            error.message += " Next step: rig --help lists the arguments."
        raise


app = typer.Typer(
    name="rig",
    cls=_Commands,
    help="Control the turntable rig: enroll objects as views at known angles, and identify them.",
    epilog="\n".join(["Exit codes", "", *(f"{code:>3}  {meaning}" for code, meaning in EXIT_CODES.items())]),
    no_args_is_help=True,
    rich_markup_mode=None,  # Rich would take a word such as [servo] for markup, and its import takes long
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"hbr-rig {version('hbr-rig')}")
        raise typer.Exit


def common(
    ctx: typer.Context,
    _version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
    **given: Unpack[CommonOptions],
) -> None:
    """Read the common options before the command; they can also follow it."""
    ctx.obj = Settings().merged(**given)


common.__doc__ = None  # or it would replace the help of the app
show_parameters(common, spread(common))
app.callback()(common)


def main() -> None:
    """Run the command line."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal that cannot show ° or − shows ? instead of a traceback
    with checked_output():
        try:
            try:
                app()
            finally:
                sys.stdout.flush()
        except OutputFailed as error:
            show_error(error, Settings())
            sys.exit(error.exit_code)
        except BrokenPipeError:
            discard(sys.stdout)
            sys.exit(EXIT_BY_SIGNAL + signal.SIGPIPE)
        except Exception:  # a mistake in this program; its text can contain anything
            import traceback

            print(neutral(traceback.format_exc()), file=sys.stderr, end="")
            step = "Report this text, the command, and the version (rig --version)."
            print(f"Error {RigError.code} ({RigError.title}).\nNext step: {step}", file=sys.stderr)
            sys.exit(RigError.code // 100)
