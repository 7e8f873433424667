"""The command line program `rig`: all commands, grouped as in its help."""

import inspect
import re
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from importlib.metadata import entry_points, version
from io import TextIOWrapper
from typing import Annotated, Any, Final, Unpack

import typer
from typer.core import TyperGroup

from rig.cli.bench import config, doctor, head, serve, servo, snapshot, table
from rig.cli.catalog import catalog, exchange, results
from rig.cli.objects import enroll, evaluate, identify, runs
from rig.cli.ui.command import show_error, without_color
from rig.cli.ui.exit_codes import EXIT_CODES
from rig.cli.ui.options import CommonOptions, show_parameters, spread
from rig.cli.ui.settings import Settings
from rig.cli.ui.terminal import checked_output, discard
from rig.core.control_characters import neutral
from rig.core.errors import OutputFailed, RigError, UsageError
from rig.core.signals import EXIT_BY_SIGNAL, handle_signals

GROUP = "rig.commands"
_WANTS_JSON = "rig.wants_json"
_TYPER_USAGE_ERROR: Any = typer.BadParameter.__base__
"""Typer exports no name for it, and the module of the class depends on Typer's version."""


class _Commands(TyperGroup):
    """All commands. With ``--json`` an error in the arguments is also printed as JSON, as other errors are."""

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        wants_json = "--json" in args
        with _usage_error(json=wants_json):
            context = super().make_context(info_name, args, parent, **extra)
        context.meta[_WANTS_JSON] = wants_json
        return context

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the commands in their sections, and then the options; the help of Typer begins with the options."""
        texts: dict[str, str] = {str(one.name): inspect.getdoc(one.callback) or "" for one in app.registered_commands}
        for group in app.registered_groups:
            texts[str(group.name)] = str(group.typer_instance.info.help) if group.typer_instance else ""
        texts = {name: neutral(re.split(r"\.\s", text)[0].removesuffix(".")) + "." for name, text in texts.items()}
        named = {name for names in SECTIONS.values() for name in names}
        sections = {
            title: [(name, texts[name]) for name in names if name in texts] for title, names in SECTIONS.items()
        }
        sections["Plug-ins"] = [(neutral(name), text) for name, text in texts.items() if name not in named]
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

    def invoke(self, ctx: Any) -> Any:
        handle_signals()  # from here on, a signal unwinds the stack; until here the program was at its start
        with _usage_error(json=ctx.meta[_WANTS_JSON]):
            return super().invoke(ctx)


class _Subcommands(TyperGroup):
    """The commands of a group, each with its first sentence; the help of Typer cuts it at the end of the line."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(
                [(name, self.commands[name].get_short_help_str(limit=200)) for name in self.list_commands(ctx)]
            )


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
    values: dict[str, Any] = {**given}
    values.pop("no_color")  # `main` has looked for it already
    ctx.obj = Settings().merged(**values)


common.__doc__ = None  # or it would replace the help of the app
show_parameters(common, spread(common))
app.callback()(common)

SECTIONS: Final[dict[str, dict[str, Any]]] = {
    "Start here": {
        "doctor": doctor.doctor,
        "empty-table": snapshot.empty_table,
        "enroll": enroll.enroll,
        "identify": identify.identify,
        "results": results.app,
        "catalog": catalog.app,
        "status": table.status,
        "stop": table.stop,
        "acknowledge": table.acknowledge,
        "serve": serve.serve,
    },
    "Saved searches and experiments": {"replay": runs.replay, "report": runs.report, "eval": evaluate.evaluate},
    "Exchange and log": {"import": exchange.import_, "export": exchange.export, "log": results.log},
    "Table": {"home": table.home, "goto": table.goto, "jog": table.jog},
    "Devices and settings": {
        "setup": doctor.setup,
        "find": doctor.find,
        "config": config.app,
        "calibrate": None,
        "snapshot": snapshot.snapshot,
        "servo": servo.app,
        "head": head.app,
    },
    "Simulated bench": {"demo": None, "faults": None, "sim-bench": None},
}
"""The commands in the sections and in the order of the help; None is a plug-in. The first section is for each day."""


def _add(name: str, one: Any) -> None:
    if isinstance(one, typer.Typer):
        app.add_typer(one, name=name, cls=_Subcommands)
    else:  # the angle of goto can be negative
        app.command(name, context_settings={"ignore_unknown_options": True} if name == "goto" else None)(one)


for _names in SECTIONS.values():
    for _name, _one in _names.items():
        if _one is not None:
            _add(_name, _one)
for _point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
    try:
        _plugin = _point.load()
    except Exception as _broken:  # the other commands work without this plug-in
        _notice = f"The plug-in {_point.value} cannot be loaded, so there is no command {_point.name}: {_broken}"
        print(neutral(_notice), file=sys.stderr)
        continue
    _add(_point.name, _plugin)


def _with_commands_for(arguments: list[str]) -> typer.Typer:
    """Return the app with the commands that a start with these arguments needs; with all if that is not clear.

    Typer builds every command that an app has, with its options, at each start: half the computing of a short command
    such as status. The help of `rig` reads only their texts.
    """
    only = copy(app)
    only.registered_commands = [one for one in app.registered_commands if one.name in arguments[:1]]
    only.registered_groups = [one for one in app.registered_groups if one.name in arguments[:1]]
    is_help = arguments in ([], ["--help"], ["-h"])
    return only if is_help or only.registered_commands or only.registered_groups else app


def main() -> None:
    """Run the command line."""
    if "--no-color" in sys.argv:
        without_color()  # before Typer prints help or a usage error
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal that cannot show ° or − shows ? instead of a traceback
    with checked_output():
        try:
            try:
                _with_commands_for(sys.argv[1:])()
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
