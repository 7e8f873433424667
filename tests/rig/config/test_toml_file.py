"""Edits of rig.toml: the value changes, and all other text stays."""

import tomllib

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from rig.config.toml_file import changed_lines, read_text, save, toml, with_values
from rig.core.errors import ConfigError

BY_HAND = """\
# The bench by the window.

default_bench = "hardware"   # not the simulated one
[servo]
  port = '/dev/ttyUSB0' # the U2D2 with the red dot
#baud = 57600
\t
# don't touch: [table] = "# not a header"
[table]
limits_deg = [ # the cable
    -400,      # taut here
    400,
]
[bench.sim]
noise = {backlash_deg=0.1}
text = \"\"\"[servo]
port = "no" # no comment\"\"\"
"""


def test_value_is_changed_in_place():
    edited = with_values(BY_HAND, {("servo", "port"): "/dev/ttyUSB7"})
    assert changed_lines(BY_HAND, edited) == [
        "-   port = '/dev/ttyUSB0' # the U2D2 with the red dot",
        '+   port = "/dev/ttyUSB7" # the U2D2 with the red dot',
    ]


def test_new_value_is_inserted_below_its_commented_default():
    edited = with_values(BY_HAND, {("servo", "baud"): 1_000_000})
    assert "#baud = 57600\nbaud = 1000000\n" in edited


def test_new_keys_and_tables_are_inserted_in_their_places():
    edited = with_values(BY_HAND, {("servo", "id"): 3, ("imu", "bus"): "/dev/i2c-3", ("state_dir",): "x"})
    assert edited.startswith(
        '# The bench by the window.\n\ndefault_bench = "hardware"   # not the simulated one\nstate_dir'
    )
    assert "  port = '/dev/ttyUSB0' # the U2D2 with the red dot\nid = 3\n" in edited
    assert edited.endswith('\n[imu]\nbus = "/dev/i2c-3"\n')


def test_long_table_of_a_value_does_not_hinder_an_edit():
    table = "a = [\n" + "  [1, 2],  # the third\n" * 1000 + "]\n"
    assert with_values(f"{table}[servo]\n", {("servo", "id"): 2}) == f"{table}[servo]\nid = 2\n"


def test_first_top_level_key_is_inserted_before_the_first_table():
    text = "# mine\nstate_dir = 'x'\n\n# about the servo\n[servo]\nid = 1"
    edited = with_values(text, {("default_bench",): "sim", ("servo", "baud"): 57600})
    begin = "# mine\nstate_dir = 'x'\ndefault_bench = \"sim\"\n\n# about the servo\n"
    assert edited == begin + "[servo]\nid = 1\nbaud = 57600\n"


def test_windows_line_ends_stay_and_empty_file_gets_a_table():
    assert with_values("a = 1\r\n", {("servo", "id"): 2}) == "a = 1\r\n\r\n[servo]\r\nid = 2\r\n"
    assert with_values("", {("servo", "id"): 2}) == "[servo]\nid = 2\n"


def test_unchanged_values_stay_as_written():
    assert with_values(BY_HAND, {("servo", "port"): "/dev/ttyUSB0", ("table", "limits_deg"): [-400, 400]}) == BY_HAND


FORMS = (
    *("[[servo]]\nid = 1\n", "servo = 3\n", "[servo]\nid = [\n1,\n]\n", "servo = { id = 1 }\n", "servo.id = 1\n"),
    'a = """\n[servo]\nid = 1\n"""\n',
)


@pytest.mark.parametrize("text", FORMS)
def test_form_that_cannot_be_edited_is_rejected_with_the_line_to_write(text):
    with pytest.raises(ConfigError, match=r"Cannot set servo\.id") as caught:
        with_values(text, {("servo", "id"): 2})
    assert "id = 2" in caught.value.next_step


def test_file_is_replaced_atomically_and_link_stays_a_link(tmp_path):
    real, link = tmp_path / "real.toml", tmp_path / "rig.toml"
    real.write_text("old = 1\n")
    link.symlink_to(real)
    save(link, "new = 2\n")
    assert link.is_symlink()
    assert read_text(real) == "new = 2\n"
    with pytest.raises(ConfigError, match="Cannot write"):
        save(real / "below" / "rig.toml", "")


# -- any document ---------------------------------------------------------------------------------------------------

names = st.sampled_from(["servo", "id", "port", "a-b", "x y", "#", "="])
strings = st.text(st.sampled_from("ab#=[]{}\"'\\\n\t\x7fé,"), max_size=8)
scalars = st.booleans() | st.integers(-9999, 9999) | st.floats() | strings
values = st.recursive(scalars, lambda inner: st.lists(inner, max_size=3), max_leaves=4)
comments = st.sampled_from(["", " # [servo]", "\t# id = 3 \"'", "#"])


@st.composite
def written_values(draw):
    """A value in one of TOML's spellings, with its comments."""
    value = draw(values)
    match draw(st.integers(0, 3)):
        case 0 if isinstance(value, list):
            inner = "".join(f"  {toml(item)}, # {draw(st.integers(0, 9))} ]\n" for item in value)
            return f"[ # begins\n{inner}# ends\n]"
        case 1:
            return "'''" + draw(st.sampled_from(["", "a # b", '"""', "\n[servo]\nid = 4\n", "''"])) + "'''"
        case 2:
            return '"""' + draw(st.sampled_from(["", 'x\\"""y', "\n# no\n[servo]\n", "'''", '""'])) + '"""'
    return toml(value)


@st.composite
def documents(draw):
    lines, tables = [], [()]
    for _ in range(draw(st.integers(0, 3))):
        table = tuple(draw(st.lists(names, min_size=1, max_size=2, unique=True)))
        if not any(table[: len(known)] == known[: len(table)] for known in tables if known):
            tables.append(table)
    for table in tables:
        if table:
            lines += [
                draw(st.sampled_from(["", "# above", "  "])),
                f"[ {'.'.join(map(toml, table))} ]" + draw(comments),
            ]
        for name in draw(st.lists(names, unique=True, max_size=3)):
            if not any(other[: len(table) + 1] == (*table, name) for other in tables):
                space = draw(st.sampled_from(["", "  "]))
                lines.append(f"{space}{toml(name)}{space}= {draw(written_values())}{draw(comments)}")
        lines.append(draw(st.sampled_from(["", f"# {draw(names)} = 1"])))
    text = "\n".join(lines) + draw(st.sampled_from(["", "\n"]))
    tomllib.loads(text)
    return text


def nothing_else(text: str, key: tuple[str, ...]) -> dict:
    """Return the document's values without ``key``."""
    values = here = tomllib.loads(text)
    for part in key[:-1]:
        here = here.setdefault(part, {})
        if not isinstance(here, dict):
            return values
    here.pop(key[-1], None)
    return values


@given(documents(), st.lists(names, min_size=1, max_size=3, unique=True).map(tuple), values)
def test_edit_of_any_document_changes_one_line_or_is_rejected(text, key, value):
    try:
        edited = with_values(text, {key: value})
    except ConfigError:
        event("rejected")
        return
    event("edited")
    here = tomllib.loads(edited)
    for part in key:
        here = here[part]
    assert repr(here) == repr(value)
    assert repr(nothing_else(edited, key)) == repr(nothing_else(text, key))
    changed = changed_lines(text, edited)
    assert len([line for line in changed if line.startswith("-")]) <= 1
    assert len(changed) <= 2
