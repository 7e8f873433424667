"""The compiled kernels have the bits of their references, on every processor, and are used only if they fit."""

import ctypes
import os
import subprocess
import sys
from pathlib import Path
from shutil import copytree, which

import cv2
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

import hbr
from hbr.dense.index import DenseIndex
from hbr.kernels import calls, library, without_library
from hbr.kernels import compile as compiling
from hbr.kernels.library import load
from hbr.paper.hough import Extension
from hbr.segmentation.background import shrunk
from hbr.segmentation.cut_out import CROP_PX
from tests.fuzzing import examples

compiled = pytest.mark.skipif(library() is None, reason="the kernels are not compiled: there is no C compiler")
seeds = st.integers(0, 2**32 - 1)


@st.composite
def images(draw: st.DrawFn) -> np.ndarray:
    """Return noise, few greys, patches and flat images of any size, also as views with other strides."""
    rng = np.random.default_rng(draw(seeds))
    height, width = (draw(st.one_of(st.integers(1, 90), st.sampled_from([159, 160, 241, 640]))) for _ in range(2))
    patch, channels = draw(st.sampled_from([1, 2, 8, 50])), draw(st.sampled_from([1, 3]))
    levels = rng.choice(256, draw(st.sampled_from([1, 2, 6, 256])))
    pixels = rng.choice(levels, (height // patch + 1, width // patch + 1, channels)).astype(np.uint8)
    image = np.kron(pixels, np.ones((patch, patch, 3 // channels), np.uint8))[:height, :width]
    match draw(st.sampled_from(["whole", "flipped", "every other row", "columns first"])):
        case "flipped":
            return image[::-1, ::-1]
        case "every other row":
            return np.repeat(image, 2, axis=0)[::2]
        case "columns first":
            return np.asfortranarray(image)
    return image


@compiled
@examples(30)
@given(images())
def test_cedd_has_the_bits_of_the_reference(image: np.ndarray) -> None:
    with without_library():
        reference = hbr.cedd(image)
    np.testing.assert_array_equal(hbr.cedd(image), reference)


@compiled
def test_cedd_has_the_bits_of_the_reference_for_every_colour() -> None:
    steps = np.stack(np.meshgrid(*[np.arange(0, 256, 5)] * 3), axis=-1).reshape(-1, 3)
    for start in range(0, len(steps) - 1600, 8 * 1600):  # each colour fills a block of its own
        image = np.kron(steps[start : start + 1600].reshape(40, 40, 3).astype(np.uint8), np.ones((2, 2, 1), np.uint8))
        with without_library():
            reference = hbr.cedd(image)
        np.testing.assert_array_equal(hbr.cedd(image), reference)


def picture(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Return noise, smooth colours, or one colour, uint8 (height, width, 3)."""
    match rng.integers(3):
        case 0:
            return rng.integers(0, 256, (height, width, 3), np.uint8)
        case 1:
            coarse = rng.integers(0, 256, (height // 20 + 2, width // 20 + 2, 3), np.uint8)
            return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.full((height, width, 3), rng.integers(256), np.uint8)


@compiled
@examples(15)
@given(seeds, st.integers(3, 11), st.integers(20, 96), st.booleans())
def test_frames_are_shrunk_as_by_opencv(seed: int, factor: int, height: int, every_other: bool) -> None:
    frame = picture(np.random.default_rng(seed), height * factor, 128 * factor)
    if every_other:
        frame = np.repeat(frame, 2, axis=0)[::2]
    with without_library():
        reference = shrunk(frame)
    np.testing.assert_array_equal(shrunk(frame), reference)


@compiled
@examples(15)
@given(seeds, st.integers(CROP_PX + 1, 500).filter(lambda size: size % CROP_PX), st.integers(0, 40))
def test_squares_are_averaged_as_by_opencv(seed: int, size: int, left: int) -> None:
    part = picture(np.random.default_rng(seed), size, size + 40)[:, left : left + size]
    expected = cv2.resize(part, (CROP_PX, CROP_PX), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(calls.average(part, CROP_PX), expected)
    with without_library():
        reference = shrunk(part)
    np.testing.assert_array_equal(shrunk(part), reference)


@compiled
@examples(12)
@given(queries=st.integers(0, 9), count=st.integers(1, 200), length=st.sampled_from([1, 31, 144, 4096]), seed=seeds)
def test_tanimoto_has_the_bits_of_the_reference(queries: int, count: int, length: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    top = 255 if seed % 3 else 1
    asked, rows = (
        (rng.integers(0, top + 1, (n, length)) * (rng.random((n, length)) < 0.4)).astype(np.uint8)
        for n in (queries, count)
    )
    rows[rng.integers(0, count, count // 3)] = rows[0]
    rows[count // 2] = rng.choice([0, 255])
    apart = np.repeat(rows, 2, axis=0)[::2]
    with without_library():
        reference = hbr.tanimoto(asked, rows)
    np.testing.assert_array_equal(hbr.tanimoto(asked, rows), reference)
    np.testing.assert_array_equal(hbr.tanimoto(asked, apart), reference)


@compiled
@examples(12)
@given(st.integers(1, 300), st.integers(0, 50), st.integers(1, 320), seeds)
def test_paper_search_is_the_same_with_and_without_kernels(count: int, more: int, k: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    levels = (rng.integers(0, 8, (count + more, 144)) * (rng.random((count + more, 144)) < 0.1)).astype(np.uint8)
    levels[rng.integers(0, len(levels), len(levels) // 3)] = levels[0]  # equal similarities
    first, rest = (
        hbr.Views(part, np.zeros(len(part)), np.zeros(len(part), np.intp), ("object",))
        for part in np.split(levels, [count])
    )
    index = hbr.ViewIndex(first).extended(rest)
    with without_library():
        reference = hbr.ViewIndex(first).extended(rest)
        wanted = reference.search(levels[0], k)
    for found, expected in zip(index.search(levels[0], k), wanted, strict=True):
        np.testing.assert_array_equal(found, expected)


@compiled
@examples(24)
@given(
    counts=st.lists(st.integers(1, 40), min_size=1, max_size=6),
    alike=st.booleans(),
    step_deg=st.sampled_from([0.0, 2.5, 5.0, 90.0]),
    omega=st.sampled_from([0.0, 0.5, 2.0, 10.0]),
    rotation_deg=st.one_of(st.floats(-720, 720), st.sampled_from([0.0, -90.0, 2.5, 2.5 + 1e-12])),
    seed=seeds,
)
@example(counts=[72] * 6, alike=True, step_deg=5.0, omega=2.0, rotation_deg=2.5 + 1e-12, seed=0)
def test_support_has_the_bits_of_the_reference(
    counts: list[int], alike: bool, step_deg: float, omega: float, rotation_deg: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    counts = counts[:1] * len(counts) if alike else counts
    total = sum(counts)
    azimuth_deg = rng.uniform(0, 360, total)
    if step_deg:  # several views at one azimuth, and azimuths half-way between bins, or nearly so
        azimuth_deg = azimuth_deg // step_deg * step_deg
    objects = np.repeat(np.arange(len(counts)), counts)
    if alike:  # all objects have the same azimuths
        azimuth_deg = np.tile(azimuth_deg[: counts[0]], len(counts))
    else:
        objects = rng.permutation(objects)
    levels = np.zeros((total, 512), np.uint8)
    index = DenseIndex(
        hbr.Views(levels, azimuth_deg, objects, tuple(map(str, range(len(counts)))), "edges"), omega=omega
    )
    similar = rng.uniform(-0.1, 1, total).astype(np.float32)
    with without_library():
        reference = index.support(similar, rotation_deg)
    np.testing.assert_array_equal(index.support(similar, rotation_deg), reference)


@pytest.mark.parametrize(
    ("compiler", "emulators"),
    [
        # vectors of at most 256 bits, and of at most 128
        (["cc"], [[], ["qemu-x86_64", "-cpu", "Haswell"], ["qemu-x86_64", "-cpu", "Nehalem"]]),
        pytest.param(["aarch64-linux-gnu-gcc", "-static"], [["qemu-aarch64"]], marks=pytest.mark.nightly),
    ],
    ids=["this machine", "aarch64"],
)
def test_every_processor_computes_the_same_bits(
    compiler: list[str], emulators: list[list[str]], tmp_path: Path
) -> None:
    """The sums were printed by an AMD EPYC."""
    emulators = [words for words in emulators if not words or which(words[0])]
    if not which(compiler[0]) or not emulators:
        pytest.skip("this compiler or the emulator of its processor is not installed")
    if compiler == ["cc"] and library() is not None:
        parts = [str(compiling.LIBRARY)]  # the library in use: a new one takes seconds
    else:
        parts = [str(path) for path in compiling.sources() if path.suffix == ".c"]
    flags = [flag for flag in compiling.FLAGS.split() if flag not in ("-shared", "-s", "-fvisibility=hidden")]
    include = ['-DHBR_SOURCES=""', f"-I{compiling.FOLDER}", str(Path(__file__).with_name("checksums.c"))]
    subprocess.run([*compiler, *flags, *include, *parts, "-o", str(tmp_path / "sums")], check=True)
    for words in emulators:
        done = subprocess.run([*words, str(tmp_path / "sums")], capture_output=True, text=True, check=True)
        *others, layers = done.stdout.splitlines()
        assert others == [
            "support 0bb02f7c7c59d451",
            "cedd d025e1b8b31f1acd",
            "paths a10b61b94fb3dd45",
            "next_view 6ea0421bf9ba6bf8",
        ]
        # processors before AVX2 round each product of a network's layers before they add it
        assert (layers == "layers 9c30ebb232645633") == ("Nehalem" not in words)


@pytest.mark.parametrize("state", ["intact", "missing", "damaged", "of other sources", "of more sources"])
def test_library_is_used_and_kept_only_if_it_fits(state: str, tmp_path: Path) -> None:
    path = Path(copytree(compiling.FOLDER, tmp_path / "kernels")) / compiling.LIBRARY.name
    match state:
        case "missing":
            path.unlink(missing_ok=True)
        case "damaged":
            path.unlink(missing_ok=True)
            path.write_bytes(b"\x7fELF" + bytes(1000))
        case "of other sources":
            (path.parent / "cedd.c").write_text("/* changed */")
        case "of more sources":
            (path.parent / "cedd.c").unlink()
    fits = state == "intact" and load(compiling.LIBRARY) is not None
    assert (load(path) is not None) == fits
    assert compiling.is_current(path) == fits


def test_a_processor_of_32_bits_uses_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(load.__globals__, "_POINTER", ctypes.c_uint32)
    assert load(compiling.LIBRARY) is None


def test_environment_switches_the_library_off() -> None:
    code = "from hbr.kernels import library; assert library() is None"
    subprocess.run([sys.executable, "-c", code], env=os.environ | {"HBR_KERNELS": "numpy"}, check=True)


def test_missing_compiler_keeps_the_earlier_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    assert compiling.compile_kernels(tmp_path / "library.so") is None
    monkeypatch.setenv("CC", "false")  # a compiler that fails
    assert compiling.compile_kernels(tmp_path / "library.so") is None
    assert list(tmp_path.iterdir()) == []


@compiled
@examples(12)
@given(
    counts=st.lists(st.integers(1, 40), min_size=1, max_size=6),
    step_deg=st.sampled_from([0.0, 2.5, 5.0, 90.0]),
    queries=st.integers(1, 8),
    list_length=st.sampled_from([1, 3, 10, 300]),
    omega=st.sampled_from([0.0, 0.5, 2.0]),
    extension=st.sampled_from(["visual", "orient", "orient_all"]),
    seed=seeds,
)
def test_paths_are_those_of_the_reference(
    counts: list[int],
    step_deg: float,
    queries: int,
    list_length: int,
    omega: float,
    extension: Extension,
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    objects = rng.permutation(np.repeat(np.arange(len(counts)), counts))
    levels = (rng.integers(0, 8, (len(objects), 144)) * (rng.random((len(objects), 144)) < 0.2)).astype(np.uint8)
    levels[rng.integers(0, len(levels), len(levels) // 3)] = levels[0]  # equal scores
    azimuth_deg, orientation_deg = rng.uniform(0, 360, len(levels)), rng.uniform(-400, 400, queries)
    if step_deg:  # equally close views
        azimuth_deg, orientation_deg = (part // step_deg * step_deg for part in (azimuth_deg, orientation_deg))
    views = hbr.Views(np.repeat(levels, 2, axis=0)[::2], azimuth_deg, objects, tuple(map(str, range(len(counts)))))
    asked = levels[rng.integers(0, len(levels), queries)]

    def ranking() -> hbr.Ranking:
        index = hbr.ViewIndex(views)
        return hbr.retrieve(asked, orientation_deg, index, omega=omega, list_length=list_length, extension=extension)

    with without_library():
        reference = ranking()
    found = ranking()
    for name in ("object_index", "scores", "pose_deg", "paths"):
        np.testing.assert_array_equal(getattr(found, name), getattr(reference, name), name)
