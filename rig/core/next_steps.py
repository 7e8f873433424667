"""The next step of an error, a note or a finding, as data that each presenter words in its own way.

A next step is a list of sentences, for what only hands can do, and of actions of the rig with their parameters. This
module words it for a terminal. The page `rig.web.pages` words it as buttons and links.

Decision: docs/decisions/0002.
"""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from enum import StrEnum, unique
from shlex import quote
from typing import Any, Final, Self

from rig.core.masking import masked


@unique
class Do(StrEnum):
    """The actions that a next step can name. Call one to give it parameters: ``Do.ENROLL(name="lamp")``."""

    words: str
    """The action in words, without capital and full stop."""
    command: str
    """The command that does it; empty if no command does. It contains ``{key}`` for parameters in fixed places. All
    other parameters are options: ``reboot=True`` is ``--reboot``."""

    def __new__(cls, value: str, words: str, command: str = "") -> Self:
        member = str.__new__(cls, value)
        member._value_, member.words, member.command = value, words, command
        return member

    def __call__(self, **parameters: Any) -> "NextStep":
        """Return the action with its parameters; those that are None or False do not apply."""
        return NextStep(
            self, {key: value for key, value in parameters.items() if value is not None and value is not False}
        )

    # the table
    ACKNOWLEDGE = "acknowledge", "acknowledge the fault", "rig acknowledge"
    ACKNOWLEDGE_IN_PROGRAM = (
        "acknowledge-in-program",
        "start the program again: this bench keeps the fault only while its program runs",
    )
    HOME_HERE = "home-here", "make the present angle home", "rig home --here"
    SET_REVOLUTIONS = (
        "set-revolutions",
        "set the revolutions of the cable to {revolutions}",
        "rig home --revolutions {revolutions}",
    )
    GOTO = "goto", "rotate the table to an angle", "rig goto {angle}"
    STOP = "stop", "stop the table and switch its torque off", "rig stop"
    STATUS = "status", "look at the state of the bench", "rig status"
    RUN_AGAIN = "run-again", "start again"
    # the bench and its devices
    DOCTOR = "doctor", "check the bench", "rig doctor"
    UDEV_RULES = "udev-rules", "write the rules of udev", "rig doctor --udev"
    REPORT_DEFECT = "report-defect", "report this with the output of the check", "rig doctor --json"
    FIND = "find", "list the connected devices", "rig find"
    SETUP = "setup", "set the bench up", "rig setup"
    SERVO_SETTINGS = (
        "servo-settings",
        "write the settings of the servo, with its torque off",
        "rig servo settings --write",
    )
    RECORD_TRACE = "record-trace", "record a trace", "rig servo record {file}"
    SERVO_ID = "servo-id", "give the servo the id {id}", "rig servo set-id {id}"
    SERVO_BAUD = "servo-baud", "set the baud rate of the servo", "rig servo set-baud {baud}"
    CALIBRATE = "calibrate", "run the calibration {name}", "rig calibrate {name}"
    # the configuration and the computer
    SET_KEY = "set-key", "set {key} to {value}", "rig config set {key} {value}"
    CHECK_CONFIGURATION = "check-configuration", "check the configuration", "rig config check"
    SHOW_CONFIGURATION = "show-configuration", "list the keys and their values", "rig config show"
    FREE_DISK = "free-disk", "free some space on the disk"
    INSTALL_EXTRA = "install-extra", "install the missing packages", "pip install 'hbr-rig[{extra}]'"
    NEW_TOKEN = "new-token", "make a token", "rig serve --new-token {name}"
    SERVE_AGAIN = "serve-again", "end the server and start it again", "rig serve"
    # objects
    ENROLL = "enroll", "enroll an object", "rig enroll {name}"
    ENROLL_AGAIN = "enroll-again", "enroll the object again", "rig enroll {name} --replace"
    CONTINUE_ENROLLMENT = "continue-enrollment", "continue the enrollment", "rig enroll {name} --resume"
    EMPTY_TABLE = "empty-table", "take a new empty-table image", "rig empty-table"
    LIST_RESULTS = "list-results", "list the results", "rig results list"
    # the catalog
    LIST_OBJECTS = "list-objects", "list the objects", "rig catalog list"
    LABEL = "label", "change the label and the note", "rig catalog label {name}"
    RENAME = "rename", "rename the other object", "rig catalog rename {name} NEW-NAME"
    UNDELETE = "undelete", "restore the object", "rig catalog undelete {name}"
    REMOVE_DELETED = "remove-deleted", "remove deleted objects from the disk", "rig catalog gc"
    VERIFY_CATALOG = "verify-catalog", "check the catalog", "rig catalog verify"
    DELIVER_RENAMED = (
        "deliver-renamed",
        "deliver the object with another name",
        "rig catalog deliver --rename {name} NEW-NAME",
    )
    DELIVER_REPLACING = "deliver-replacing", "replace the object on the server", "rig catalog deliver --replace {name}"
    DISCARD = "discard", "discard the object in the journal", "rig catalog deliver --discard {name}"
    # simulation
    LIST_FAULTS = "list-faults", "list the simulated faults", "rig faults"
    SIM_BENCH = "sim-bench", "run the simulated bench in another terminal", "rig sim-bench"
    END_SIM_BENCH = "end-sim-bench", "end it", "rig sim-bench --folder {folder} quit"


_KEY: Final = re.compile(r"{(\w+)}")
_ACTIONS: Final = {str(action): action for action in Do}


@dataclass(frozen=True, slots=True)
class NextStep:
    """An action that the operator does next."""

    action: Do
    """What to do."""
    parameters: dict[str, Any] = field(default_factory=dict)
    """Its parameters. Passwords in them are masked."""
    # Made from the action also when a step is read: a stored command is not used.
    command: str | None = field(default=None, compare=False)
    """The command line; an unknown parameter is in capitals. Null if no command does the action."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", masked(self.parameters))
        words = _KEY.sub(lambda key: quote(str(self.parameters.get(key[1], key[1].upper()))), self.action.command)
        if words.startswith("rig "):
            words = " ".join([words, *self._given_options()])
        object.__setattr__(self, "command", words or None)

    def with_options(self, options: Iterable[str]) -> Self:
        """Return the step with options that select the bench and its configuration: ``--bench sim``."""
        step = replace(self)
        if step.command is not None and step.command.startswith("rig "):
            object.__setattr__(step, "command", " ".join([step.command, *map(quote, options)]))
        return step

    @property
    def words(self) -> str:
        """The action in words, for a terminal, without capital and full stop."""
        if self.action is Do.RUN_AGAIN and self.parameters:
            return f"{self.text} with {' '.join(self._given_options())}"
        return f"{self.text}: `{self.command}`" if self.command else self.text

    @property
    def text(self) -> str:
        """The action in words, without a command."""
        return _KEY.sub(lambda key: str(self.parameters.get(key[1], key[1].upper())), self.action.words)

    def _given_options(self) -> Iterator[str]:
        """Yield the words of the parameters that are options of the command."""
        placed = _KEY.findall(self.action.command)
        for key, value in self.parameters.items():
            if key not in placed:
                yield f"--{key.replace('_', '-')}" + ("" if value is True else f" {quote(str(value))}")


NextSteps = tuple[str | NextStep, ...]
"""Sentences and actions, in order. A sentence may end open before an action: ``"If the cable hangs free,"``."""
START_AGAIN: Final[NextSteps] = (Do.RUN_AGAIN(), "Or", Do.CONTINUE_ENROLLMENT())
"""After a motion that was interrupted."""
SomeSteps = str | NextStep | Iterable[str | NextStep]
"""What a next step can be given as."""


def as_steps(given: SomeSteps) -> NextSteps:
    """Return a next step as a list; passwords in its sentences are `masked`."""
    if isinstance(given, str | NextStep):
        given = (given,)
    return tuple(masked(step) for step in given if step)


def for_bench(steps: SomeSteps, options: Iterable[str]) -> NextSteps:
    """Return a next step whose commands have the options that select the bench, unless they name one themselves."""
    given = tuple(options)
    return tuple(
        step if isinstance(step, str) or "bench" in step.parameters else step.with_options(given)
        for step in as_steps(steps)
    )


def in_words(steps: SomeSteps) -> str:
    """Return a next step as a terminal shows it, with commands."""
    words = ""
    for step in as_steps(steps):
        if isinstance(step, str):
            text = step
        else:
            text = f"{step.words}."
            if not words:
                text = f"{text[0].upper()}{text[1:]}"
            elif words.endswith((".", "?")):
                text = f"Then {text}"
        words = f"{words} {text}".lstrip()
    return words


def steps_from_json(values: Any) -> NextSteps:
    """Return the next step of its JSON values; what is not one is left out: a saved run may be damaged."""
    steps: list[str | NextStep] = []
    for value in values if isinstance(values, list | tuple) else ():
        match value:
            case str():
                steps.append(value)
            case {"action": str(action), "parameters": dict(parameters)} if action in _ACTIONS:
                steps.append(NextStep(_ACTIONS[action], parameters))
    return tuple(steps)
