"""The bench of photographs, through the commands of its users."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import Result
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from rig.bench import open_bench
from rig.catalog import Catalog
from rig.cli.main import app
from rig.config import load_config
from rig.core.clock import SystemClock
from sim.objects.projection import Image
from sim.photographs import PhotographedObjects, PhotographOptions, PhotographsOnTable

SIZE = 100
GROUND = (120, 70, 30)
COLOURS = {"obj1": (40, 40, 230), "obj2": (60, 220, 240), "obj10": (230, 230, 230)}
QUIET = ("read_noise_e", "full_well_e", "vignetting", "light_flicker", "lost_frames", "encoder_noise_deg")

Rig = Callable[..., Result]


def drawn(name: str, angle: float) -> Image:
    """A block with a spot; the place and the colour of the spot tell the angle."""
    image = np.full((SIZE, SIZE, 3), GROUND, np.uint8)
    half = round(16 + 12 * abs(np.cos(np.radians(angle))))
    cv2.rectangle(image, (50 - half, 25), (50 + half, 80), COLOURS[name], -1)
    spot = (20, 160, 20) if np.cos(np.radians(angle)) > -1e-9 else (160, 20, 120)
    cv2.circle(image, (round(50 + half * 0.6 * np.sin(np.radians(angle))), 40), 6, spot, -1)
    return image


def save(folder: Path, *names: str, step_deg: float = 45.0, suffix: str = "png") -> Path:
    folder.mkdir(exist_ok=True)
    for name in names or COLOURS:
        for angle in np.arange(0, 360, step_deg):
            assert cv2.imwrite(str(folder / f"{name}__{angle:g}.{suffix}"), drawn(name, angle))
    return folder


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rig:
    """Return a function that runs `rig ...` on the bench of the photographs in the folder ``photographs``."""
    monkeypatch.chdir(tmp_path)
    Path("rig.toml").write_text(
        'default_bench = "photographs"\nstate_dir = "state"\ncalibration_dir = "calibrations"\n'
        '[catalog]\npath = "catalog"\n[bench.photographs]\nsource = "photographs"\n'
    )
    return lambda *words, **options: CliRunner().invoke(app, [str(word) for word in words], **options)


def put(**options: object) -> list[str]:
    """Return the words that set these options of the bench."""
    return [word for key, value in options.items() for word in ("--set", f"bench.photographs.{key}={value}")]


WITHOUT_NOISE = put(**{f"noise.{name}": 0 for name in QUIET})


def stored_views(name: str) -> list[tuple[float, Image]]:
    with Catalog.open("catalog", clock=SystemClock(), read_only=True) as catalog:
        views = catalog.object(name).complete.views
        return [(view.azimuth_deg, catalog.read_image(view.image)) for view in views]


def nearest_angle(name: str, image: Image, step_deg: float) -> float:
    """Return the angle of the photograph that an image shows."""
    angles = np.arange(0, 360, step_deg)
    return float(angles[np.argmin([np.abs(image.astype(float) - drawn(name, angle)).mean() for angle in angles])])


def apart(first_deg: float, second_deg: float) -> float:
    return abs((first_deg - second_deg + 180) % 360 - 180)


def test_enrollment_takes_each_photograph_with_its_own_angle(rig: Rig) -> None:
    save(Path("photographs"))
    done = rig("enroll", "obj1", "--yes", *WITHOUT_NOISE)
    assert done.exit_code == 0, done.output
    views = stored_views("obj1")
    assert len(views) == 8  # as many as there are photographs
    for azimuth_deg, image in views:
        assert image.shape == (SIZE, SIZE, 3)
        assert apart(azimuth_deg, nearest_angle("obj1", image, 45)) < 1
        np.testing.assert_allclose(image, drawn("obj1", round(azimuth_deg / 45) * 45 % 360), atol=1)


def test_table_angles_in_the_names_run_the_other_way(tmp_path: Path) -> None:
    source = save(tmp_path, "obj1", step_deg=90)
    found = PhotographedObjects.read(PhotographOptions(source=source, table_angles=True)).enrolled["obj1"]
    shown = dict(zip(found.azimuth_deg.tolist(), (path.stem for path in found.files), strict=True))
    assert shown == {0.0: "obj1__0", 90.0: "obj1__270", 180.0: "obj1__180", 270.0: "obj1__90"}


def test_table_of_a_file_gives_objects_angles_and_the_region(rig: Rig) -> None:
    save(Path("photographs"))
    rows = [f"cup,{angle},photographs/obj1__{angle}.png,10 5 80 90" for angle in range(0, 360, 90)]
    Path("views.csv").write_text("\n".join(["object,azimuth_deg,image,region", *rows]))
    done = rig("enroll", "cup", "--yes", *put(source="views.csv"))
    assert done.exit_code == 0, done.output
    with Catalog.open("catalog", clock=SystemClock(), read_only=True) as catalog:
        assert [view.region for view in catalog.object("cup").complete.views] == [(10, 5, 80, 90)] * 4
    found = PhotographedObjects.read(PhotographOptions(source=Path("views.csv")))
    assert found.fitted(load_config(None, ["view.roi=[10, 10, 50, 50]"])).view.roi == (10, 10, 50, 50)  # as it is set


@pytest.mark.nightly
def test_fault_replaces_the_object_by_another_one_of_the_photographs(rig: Rig) -> None:
    save(Path("photographs"))
    rig("enroll", "obj1", "--yes", *WITHOUT_NOISE, *put(faults='["object_moved:other=3:angle=0@move3"]'))
    colours = [tuple(image[70, 50].tolist()) for _, image in stored_views("obj1")]
    assert set(colours[:2]) == {COLOURS["obj1"]}
    assert set(colours[4:]) == {COLOURS["obj2"]}  # the third one of the sorted names


@pytest.mark.nightly
def test_demo_enrolls_photographs_and_searches_in_the_others(rig: Rig) -> None:
    save(Path("photographs"), step_deg=22.5)
    done = rig("demo", "--objects", "photographs", "--count", "2", "--json", *put(every=2))
    totals = json.loads(done.stdout.splitlines()[-1])
    assert (totals["enrolled"], totals["views_enrolled"], totals["of_unknown"]) == (2, 16, 1)
    moved = rig("demo", "--objects", "photographs", "--change", "placement")
    assert moved.exit_code == 2
    assert "cannot be moved" in moved.stderr


def test_objects_are_found_by_the_photographs_that_were_not_enrolled(rig: Rig) -> None:
    save(Path("photographs"), step_deg=22.5)
    Path("tray.csv").write_text("name\nobj2\nobj10\n")
    assert rig("enroll", "--list", "tray.csv", "--yes", *put(every=2)).exit_code == 0
    for name in ("obj2", "obj10"):
        for azimuth_deg, image in stored_views(name):
            shown_deg = nearest_angle(name, image, 22.5)
            assert shown_deg % 45 == 0
            assert apart(azimuth_deg, shown_deg) < 1
    chosen = put(every=2, object=json.dumps("obj10"), yaw_deg=67.5)
    done = rig("identify", "--json", "--save-run", "run", *chosen)
    answer = next(event for event in map(json.loads, done.stdout.splitlines()) if event.get("event") == "identified")
    assert answer["name"] == "obj10"
    assert apart(answer["yaw_deg"], 67.5) < 45 / 2 + 1  # between two enrolled photographs
    images = [cv2.imread(str(path)) for path in sorted(Path("run").glob("**/*.png"))]
    frames = [image for image in images if image.shape[:2] == (SIZE, SIZE)]
    assert frames
    assert all(nearest_angle("obj10", frame, 22.5) % 45 == 22.5 for frame in frames)


def test_empty_table_is_shown_from_its_image(rig: Rig) -> None:
    save(Path("photographs"))
    missing = rig("empty-table")
    assert missing.exit_code == 2
    assert "cannot be taken away" in missing.stderr
    assert "bench.photographs.empty_table" in missing.stderr
    image = np.full((SIZE, SIZE, 3), GROUND, np.uint8)
    cv2.imwrite("empty.png", image)
    given = put(empty_table="empty.png")
    assert rig("empty-table", *given).exit_code == 0
    assert rig("snapshot", "seen.png", *given, *WITHOUT_NOISE).exit_code == 0
    np.testing.assert_allclose(cv2.imread("seen.png"), image, atol=1)
    done = rig("enroll", "obj1", *given)
    assert done.exit_code == 0
    with Catalog.open("catalog", clock=SystemClock(), read_only=True) as catalog:
        assert catalog.object("obj1").complete.sessions[0].empty_table is not None


def test_empty_table_has_an_image_for_each_angle(rig: Rig) -> None:
    save(Path("photographs"), step_deg=90)
    Path("tables").mkdir()
    for angle in range(0, 360, 90):
        cv2.imwrite(f"tables/{angle}.png", np.full((SIZE, SIZE, 3), 40 + angle // 3, np.uint8))
    given = [*put(empty_table="tables"), *WITHOUT_NOISE]
    assert rig("goto", "90", *given).exit_code == 0
    with open_bench("photographs", load_config(Path("rig.toml"), given[1::2])) as bench:
        seen = bench.camera.capture(bench.clock.now_ns()).image_bgr
    assert seen.mean() == pytest.approx(40 + 270 // 3, abs=1)  # the camera is at the azimuth 270°
    for name in COLOURS:
        cv2.imwrite(f"tables/{name}.png", np.full((SIZE, SIZE, 3), len(name), np.uint8))
    done = rig("snapshot", "seen.png", *given)
    assert done.exit_code == 3
    assert "for each object" in done.stderr


def test_doctor_finds_no_problem_with_the_camera(rig: Rig) -> None:
    save(Path("photographs"))
    done = rig("doctor", "--json", "--only", "camera")
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert not [one for one in found if one.get("level") == "bad"], done.stdout


def replaced(image: Image) -> Callable[[Path], object]:
    """Return a function that saves photographs, and one of them with this image."""
    return lambda folder: cv2.imwrite(str(save(folder) / "obj1__90.png"), image)


def small(folder: Path) -> None:
    folder.mkdir()
    cv2.imwrite(str(folder / "obj1__0.png"), np.zeros((60, 60, 3), np.uint8))


def damaged(folder: Path) -> None:
    file = save(folder) / "obj1__90.png"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


@pytest.mark.parametrize(
    ("prepare", "said", "step"),
    [
        (lambda _: None, "There is no folder photographs", "bench.photographs.source"),
        (Path.mkdir, "No photograph in photographs", "bench.photographs.pattern"),
        (lambda folder: save(folder, step_deg=360), "obj1 has 1 photograph to enroll it with", "Add photographs"),
        (replaced(np.zeros((90, SIZE, 3), np.uint8)), "obj1__90.png has 100 x 90 pixels", "one size"),
        (small, "60 x 60 pixels", "Scale the photographs"),
        (damaged, "obj1__90.png cannot be used: truncated", "Replace or remove"),
    ],
)
def test_unusable_photographs_are_errors_with_a_next_step(
    rig: Rig, prepare: Callable[[Path], object], said: str, step: str
) -> None:
    prepare(Path("photographs"))
    done = rig("enroll", "obj1", "--yes")
    assert done.exit_code in (2, 3)
    what, _, next_step = " ".join(done.stderr.split()).partition("Next step:")
    assert said in what
    assert step in next_step


def test_bench_without_a_source_names_the_key(rig: Rig) -> None:
    Path("rig.toml").write_text('default_bench = "photographs"\n')
    done = rig("status")
    assert done.exit_code == 3
    assert "rig config set bench.photographs.source FOLDER" in done.stderr
    assert rig("config", "show").exit_code == 0


def test_grey_photographs_and_unused_files_do_not_disturb(rig: Rig) -> None:
    folder = save(Path("photographs"))
    for path in folder.iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    cv2.imwrite(str(folder / "cover.png"), np.zeros((9, 9), np.uint8))
    (folder / "notes.txt").write_text("obj")
    assert rig("enroll", "obj1", "--yes").exit_code == 0
    assert "1 file of photographs not used: cover.png" in " ".join(rig("status").output.split())


@given(st.lists(st.floats(0, 359.9), min_size=1, max_size=20, unique=True), st.floats(-1000, 1000))
def test_no_photograph_is_nearer_than_the_one_shown(angles: list[float], azimuth: float) -> None:
    thing = PhotographsOnTable.of("obj1", [(angle, Path(str(angle))) for angle in sorted(angles)])
    away = [abs(np.angle(np.exp(1j * np.radians(a - azimuth)), deg=True)) for a in sorted(angles)]
    assert away[thing.nearest(azimuth)] == pytest.approx(min(away), abs=1e-6)
