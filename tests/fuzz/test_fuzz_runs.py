"""Saved runs and images from an attacker."""

import json
import shutil
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from rig.views.image_files import BadImage, decode
from tests.fuzz.commands import cases
from tests.fuzzing import fuzz_settings
from tests.rig.search.run_samples import saved_runs

pytestmark = pytest.mark.timeout(7200)

FILES = ["run.json", "events.jsonl", "model.jsonl", "frames/000.png", "empty_table.png"]
EVIL = [
    *(None, True, -1, 0, 10**12, 10**400, 1e308, -1e308, 1e-320, "", "a", [], {}, [[]], [None], {"": None}),
    *("\x1b[2J", "\u202e", "../../outside/secret.txt", "onnx:/dev/zero", "onnx:../../outside/secret.txt", "0" * 300),
]
VALUES = st.one_of(st.sampled_from(EVIL), st.integers(), st.floats(allow_nan=False, allow_infinity=False), st.text())


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return the folders of a run of each kind."""
    return [folder for folder, _ in saved_runs(tmp_path_factory.mktemp("runs"), ["ahbr"]).values()]


def paths(value: Any, above: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the path of every value inside of JSON values."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [above, *(path for key, inner in items for path in paths(inner, (*above, key)))]


def replaced(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    if not path:
        return new
    copy = value.copy()
    copy[path[0]] = replaced(value[path[0]], path[1:], new)
    return copy


def spoil(file: Path, kind: str, data: Any) -> None:
    """Damage a file of a run."""
    content = file.read_bytes()
    if kind == "gone":
        file.unlink()
    elif kind == "link":
        file.unlink()
        file.symlink_to(data.draw(st.sampled_from(["/dev/zero", "../../outside/secret.txt", file.name, "."])))
    elif kind == "cut":
        file.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    elif kind == "value" and file.suffix == ".png":
        sides = [data.draw(st.sampled_from([0, 1, 15, 16, 239, 320, 8001, 60_000, 2**31])) for _ in range(2)]
        file.write_bytes(content[:16] + struct.pack(">II", *sides) + content[24:])
    elif kind == "value":
        lines = content.decode().splitlines() if file.suffix == ".jsonl" else [content.decode()]
        number = data.draw(st.integers(0, len(lines) - 1))
        values = json.loads(lines[number])
        places = paths(values)
        depth = data.draw(st.integers(0, max(map(len, places))))  # or most would be in long lists of numbers
        place = data.draw(st.sampled_from([one for one in places if len(one) == depth]))
        lines[number] = json.dumps(replaced(values, place, data.draw(VALUES)))
        file.write_text("\n".join(lines) + "\n", encoding="utf-8", errors="surrogateescape")
    else:
        start = data.draw(st.integers(0, len(content)))
        file.write_bytes(content[:start] + data.draw(st.binary(max_size=8)) + content[start + 4 :])


@cases(14)
@given(
    st.integers(0, 1),
    st.sampled_from(FILES + FILES[:3]),
    st.sampled_from(["value", "value", "value", "cut", "bytes", "link", "gone"]),
    st.sampled_from(["replay", "replay --json", "replay --check", "replay --check --json", "report"]),
    st.data(),
)
def test_any_saved_run_ends_with_a_documented_exit_code(commands, runs, number, name, kind, command, data):
    run = Path(shutil.copytree(runs[number], commands.fresh() / "run"))
    assume((run / name).exists())
    spoil(run / name, kind, data)
    commands.run(*command.split(), "run")


IMAGE = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
IMAGES = [cv2.imencode(suffix, IMAGE)[1].tobytes() for suffix in (".png", ".jpg")]


@st.composite
def images(draw: st.DrawFn) -> bytes:
    """Return a damaged image file."""
    content = bytearray(draw(st.sampled_from(IMAGES)))
    for _ in range(draw(st.integers(0, 4))):
        content[draw(st.integers(0, len(content) - 1))] = draw(st.integers(0, 255))
    if draw(st.booleans()):
        content[16:24] = struct.pack(">II", draw(st.integers(0, 2**32 - 1)), draw(st.integers(0, 70_000)))
    end = draw(st.sampled_from([len(content), len(content) // 2, 40, 8]))
    return bytes(content[:end]) + draw(st.sampled_from([b"", b"\xff\xd9", b"IEND\xaeB`\x82"]))


@fuzz_settings(0.4)
@given(images())
@example(b"")
def test_any_image_is_decoded_or_rejected(content):
    try:
        image = decode(content)
    except BadImage:
        return
    assert image.dtype == np.uint8
    assert image.shape[2] == 3


@cases(4)
@given(images(), st.sampled_from(["obj1__0.png", "obj1__0.jpg"]))
def test_any_image_is_imported_or_rejected(commands, content, name):
    folder = commands.fresh() / "photos"
    folder.mkdir()
    for angle in range(0, 360, 90):
        (folder / f"obj1__{angle}.png").write_bytes(IMAGES[0])
    (folder / "obj1__0.png").unlink()
    (folder / name).write_bytes(content)
    commands.run("import", "photos", "--dry-run", "--jobs", "1", "--bench", "sim")
