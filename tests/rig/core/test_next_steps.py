"""The next step of an error: its actions, their words, and that no text for people names a command by itself."""

import ast
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main
from hypothesis import example, given
from hypothesis import strategies as st

from rig.cli.main import app
from rig.core.json_form import plain
from rig.core.next_steps import Do, as_steps, for_bench, in_words, steps_from_json
from tests.fuzzing import examples

ROOT = Path(__file__).parents[3]
FOR_TERMINALS = ("rig/cli", "sim/demo", "sim/realtime")
"""Rooms whose errors are shown at terminals only: they may name options of their own command."""


@pytest.mark.parametrize(
    ("steps", "words"),
    [
        ("Check the cable.", "Check the cable."),
        (Do.ACKNOWLEDGE(), "Acknowledge the fault: `rig acknowledge`."),
        (("Wait.", Do.ACKNOWLEDGE(reboot=True)), "Wait. Then acknowledge the fault: `rig acknowledge --reboot`."),
        (("Wait, or", Do.STOP()), "Wait, or stop the table and switch its torque off: `rig stop`."),
        (Do.ENROLL(), "Enroll an object: `rig enroll NAME`."),
        (Do.ENROLL(name="a cup"), "Enroll an object: `rig enroll 'a cup'`."),
        (Do.GOTO(angle=None), "Rotate the table to an angle: `rig goto ANGLE`."),
        (Do.ACKNOWLEDGE_IN_PROGRAM(reboot=True), f"{Do.ACKNOWLEDGE_IN_PROGRAM.words.capitalize()}."),
        (Do.RUN_AGAIN(on_conflict="skip"), "Start again with --on-conflict skip."),
        (Do.INSTALL_EXTRA(extra="web"), "Install the missing packages: `pip install 'hbr-rig[web]'`."),
        (Do.SET_REVOLUTIONS(revolutions=-1), "Set the revolutions of the cable to -1: `rig home --revolutions -1`."),
        ((), ""),
    ],
)
def test_terminal_words_a_step_as_a_command(steps, words):
    assert in_words(steps) == words
    assert steps_from_json(plain(as_steps(steps))) == as_steps(steps)


@examples(20)
@given(
    st.recursive(
        st.none() | st.integers() | st.text(max_size=5) | st.sampled_from(list(Do)),
        lambda inner: st.lists(inner) | st.dictionaries(st.sampled_from(["action", "parameters", "x y"]), inner),
    )
)
@example([{"action": "enroll", "parameters": 3}, {"action": "no such action", "parameters": {}}, {}, 3, "Wait."])
def test_damaged_steps_are_left_out(values):
    steps = steps_from_json(values)
    in_words(steps)
    assert steps_from_json(plain(steps)) == steps


def test_passwords_are_masked_in_sentences_and_parameters():
    steps = as_steps(("Use api_token=1234.", Do.SET_KEY(key="catalog.url", value="postgresql://ada:1234@host/db")))
    assert "1234" not in in_words(steps) + str(plain(steps))


def _product(*words: str) -> Iterator[tuple[str, ast.Module]]:
    """Yield the modules that have one of the words: to parse all of them takes a second."""
    for room in ("rig", "calibration", "sim"):
        for path in (ROOT / room).rglob("*.py"):
            text = path.read_text()
            if any(word in text for word in words):
                yield path.relative_to(ROOT).as_posix(), ast.parse(text)


def _named_steps() -> Iterator[tuple[Do, set[str]]]:
    """Yield each action that the product names, with the names of its parameters."""
    for _, module in _product("Do."):
        for node in ast.walk(module):
            match node:
                case ast.Call(func=ast.Attribute(value=ast.Name(id="Do"), attr=name), keywords=keywords):
                    yield Do[name], {str(one.arg) for one in keywords}


def _parsed(command: Any, words: list[str]) -> set[str]:
    """Return the options of a command line that has no mistake; options of a group may precede its command."""
    options = set()
    while (name := next((word for word in words if word in getattr(command, "commands", ())), None)) is not None:
        options |= {option for one in command.params for option in one.opts}
        at = words.index(name)
        assert {word for word in words[:at] if word.startswith("-")} <= options
        command, words = command.commands[name], words[at + 1 :]
    command.make_context("rig", list(words))
    return options | {option for one in command.params for option in one.opts}


def test_each_command_exists_with_its_options():
    root, named = typer.main.get_command(app), list(_named_steps())
    assert {action for action, _ in named} | {Do.ACKNOWLEDGE_IN_PROGRAM} == set(Do)  # no member is unused
    assert all(keys for action, keys in named if action is Do.SET_REVOLUTIONS)  # a page has a button for it
    for action, keys in named:
        if action.command.startswith("rig "):
            placed = dict.fromkeys(re.findall(r"{(\w+)}", action.command), "1")
            options = _parsed(root, shlex.split(action(**placed).command)[1:])
            assert {f"--{key.replace('_', '-')}" for key in keys - set(placed)} <= options, (action, keys)


def _texts(node: ast.AST) -> str:
    return " ".join(one.value for one in ast.walk(node) if isinstance(one, ast.Constant) and isinstance(one.value, str))


def test_no_next_step_names_a_command_in_a_text():
    """A sentence with a command would be shown on a page, to an operator in gloves. Use a member of `Do`."""
    command = re.compile(r"`rig |\brig [a-z-]+( [a-z-]+)? (--|NAME\b)|Ctrl\+C|(?<![\w-])--[a-z]")
    wrong, seen = [], 0
    for where, module in _product("step", "fix"):
        for node in ast.walk(module):
            match node:
                case ast.keyword(arg="next_step" | "steps", value=value):
                    pass
                case ast.Assign(targets=[ast.Name(id="step" | "fix" | "next_step")], value=value):
                    pass
                case _:
                    continue
            seen += 1
            found = command.search(re.sub(r"`(?!rig )[^`]*`|v4l2-ctl .*", "", _texts(value)))
            if found and ("`rig " in found[0] or not where.startswith(FOR_TERMINALS)):
                wrong.append(f"{where}:{value.lineno}: {found[0]}")
    assert seen > 300
    assert not wrong


def test_commands_for_a_bench_select_it_unless_they_name_one():
    steps = ("Look.", Do.LIST_OBJECTS(), Do.ENROLL(bench="hardware"))
    words = in_words(for_bench(steps, ("--bench", "sim")))
    assert "`rig catalog list --bench sim`" in words
    assert "`rig enroll NAME --bench hardware`" in words
