"""Configurations, settings and arguments from an attacker."""

import tomllib
from contextlib import suppress

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rig.config import RigConfig, load_config
from rig.config.toml_file import toml, with_values
from rig.config.wording import key_info
from rig.core.errors import ConfigError, UsageError
from rig.plans.tray import read_tray
from tests.fuzz.commands import cases
from tests.fuzzing import fuzz_settings

pytestmark = pytest.mark.timeout(7200)

KEYS = [info.name for info in key_info(RigConfig)] + ["bench.sim.object", "bench.sim.faults", "bench.sim.noise", "x.y"]
EXTREMES = [
    *("0", "-1", "1e-320", "-1e308", "inf", "nan", "9" * 19, "9" * 400, "9" * 5000, "0x7fffffffffffffff", "true", '""'),
    *("[]", "{}", "[" * 2000, "[" * 20 + "]" * 20, "{a=" * 30 + "1" + "}" * 30, '"\x1b[2J"', "'''", '"a\nb"', "1\n2"),
    *("../../outside/secret.txt", "/dev/zero", "onnx:/dev/zero", '"' + "a" * 3000 + '"', "\u202e", "[1e18, 0, 0, 0]"),
]
NUMBERS = st.one_of(st.integers(), st.floats(), st.integers(-3, 300), st.floats(-500, 500)).map(repr)
VALUES = st.one_of(
    st.sampled_from(EXTREMES), NUMBERS, st.text(max_size=20), st.lists(NUMBERS, max_size=5).map(", ".join)
)
SETTINGS = st.builds("{}={}".format, st.sampled_from(KEYS), VALUES)
FILES = st.one_of(
    st.lists(st.builds("{} = {}".format, st.sampled_from(KEYS), VALUES), max_size=6).map("\n".join),
    st.text(alphabet="ab.[]{}='\"#\n\\ 1,", max_size=60),
    st.text(max_size=60),
)


@fuzz_settings(0.3)
@given(FILES, st.lists(SETTINGS, max_size=2))
@example("a=" + "[" * 40_000, [])
@example("a={" * 3000, [])
def test_any_configuration_is_read_or_a_config_error(tmp_path_factory, text, overrides):
    file = tmp_path_factory.getbasetemp() / "fuzzed.toml"
    file.write_text(text, encoding="utf-8", errors="surrogateescape", newline="")
    with suppress(ConfigError):
        load_config(file, overrides)


@fuzz_settings(0.2)
@given(FILES, st.sampled_from(KEYS), VALUES)
def test_any_edit_changes_one_key_or_is_a_config_error(text, key, value):
    path = tuple(key.split("."))
    try:
        edited = with_values(text, {path: value})
    except ConfigError:
        return
    here = tomllib.loads(edited)
    for part in path:
        here = here[part]
    assert here == value
    assert toml(value)


@cases(6)
@given(FILES, st.lists(SETTINGS, max_size=2), st.sampled_from([["config", "check"], ["config", "show"], ["status"]]))
@example("", ["imu.rate_hz=6"], ["status"])
def test_any_configuration_ends_with_a_documented_exit_code(commands, text, overrides, command):
    (commands.fresh() / "fuzzed.toml").write_text(text, encoding="utf-8", errors="surrogateescape", newline="")
    options = [word for one in overrides if "\0" not in one for word in ("--set", one)]
    commands.run(*command, "--config", "fuzzed.toml", "--bench", "sim", *options)


EVIL = [
    "",
    "-1",
    "nan",
    "1e999",
    "9" * 5000,
    "../../outside/secret.txt",
    "/dev/zero",
    "\x1b]0;x\x07",
    "\u202e",
    "-",
    "--",
]
ARGUMENTS = st.one_of(
    st.sampled_from(EVIL), st.text(max_size=12).filter(lambda text: "\0" not in text), st.integers().map(str)
)
COMMANDS = [
    *("config show", "config set", "config check", "catalog list", "catalog show", "catalog rename"),
    *("catalog label", "catalog delete", "catalog verify", "catalog gc", "log", "status", "goto"),
    *("home", "stop", "acknowledge", "replay", "report", "export", "import", "servo", "eval"),
]
OPTIONS = [
    "--json",
    "--yes",
    "--seed",
    "--views",
    "--revolutions",
    "--config",
    "--list",
    "--check",
    "--set",
    "--dry-run",
]


@cases(10)
@given(st.sampled_from(COMMANDS), st.lists(st.one_of(ARGUMENTS, st.sampled_from(OPTIONS)), max_size=4))
@example("goto", ["nan"])
@example("goto", ["--", "-1e308"])
@example("home", ["--revolutions", "99999999"])
@example("home", ["--here", "--revolutions", "-99999999", "--json"])
@example("replay", ["/dev/zero", "--json"])
@example("import", ["9" * 256])
@example("eval", ["--json", "9/" * 2100])
@example("status", ["--seed", "9" * 4000])
@example("config show", ["--set", "--json"])
@example("config show", ["--seed"])
@example("config show", ["--", "--json"])
def test_any_arguments_end_with_a_documented_exit_code(commands, command, arguments):
    commands.fresh()
    commands.run(*command.split(), "--bench", "sim", *arguments)


NAMES = st.one_of(
    st.sampled_from([*EVIL, ".", "..", "a/b", "con", "a" * 300, "\u2028", "a\nb", "\udcff", "mug\x9b31m"]),
    st.text(max_size=30).filter(lambda text: "\0" not in text),
)


@cases(5)
@given(NAMES, st.sampled_from(["catalog show", "catalog show --json", "catalog delete --yes"]))
@example("\udcff", "catalog show --json")  # a byte that is not UTF-8
def test_any_name_ends_with_a_documented_exit_code(commands, name, command):
    commands.fresh()
    commands.run(*command.split(), "--bench", "sim", "--", name)


CELLS = st.one_of(st.sampled_from([*EVIL, "mug-white", "4", "721", '"', '"a', "a;b"]), st.text(max_size=8))
LISTS = st.one_of(
    st.builds(
        lambda heading, rows: "\n".join([heading, *(",".join(row) for row in rows)]).encode(errors="surrogateescape"),
        st.sampled_from(
            ["name", "name,label", "name;views", "name,label,note,views", "views", "\ufeffname", "name,name"]
        ),
        st.lists(st.lists(CELLS, max_size=5), max_size=5),
    ),
    st.binary(max_size=60),
)


@cases(5)
@given(LISTS)
@example(b"name\n" + b'"' * 200_000)
@example(b"name\n" + b"a\0b\n")
@example(b"name\n" + b"x" * 140_000)
def test_any_list_is_read_or_rejected(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("lists") / "list.csv"
    path.write_bytes(content)
    with suppress(UsageError):
        assert read_tray(path)
