"""`rig eval` as its users call it, on folders of small drawn photographs."""

import csv
import json
import re
import shutil
from hashlib import sha256
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from rig.catalog import Catalog, Provenance, View
from rig.cli.objects.evaluate import evaluate
from rig.core.clock import SystemClock
from rig.evaluation.experiments import load_experiment, rotation_errors, shipped
from tests.programs import server

app = typer.Typer()
app.command("eval")(evaluate)

QUICK = "trials = 2\nmax_views = 4\n"
NOISY = 'methods = "hbr,ahbr"\nnoise = "mb:5"\n'


def drawing(number: int, angle: float, size: int = 40) -> np.ndarray:
    """An ellipse with a coloured spot that goes around it."""
    rng = np.random.default_rng(number)
    image = np.zeros((size, size, 3), np.uint8)
    half = size // 2 - 2
    axes = half, half * (3 + number % 4) // 6
    cv2.ellipse(image, (size // 2, size // 2), axes, 30.0 * number, 0, 360, rng.integers(60, 256, 3).tolist(), -1)
    x, y = size / 2 + size / 4 * np.cos(np.radians(angle)), size / 2 - size / 4 * np.sin(np.radians(angle))
    cv2.circle(image, (round(x), round(y)), size // 7, rng.integers(0, 256, 3).tolist(), -1)
    return image


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photographs")
    for number in range(1, 5):
        for angle in range(0, 360, 30):
            assert cv2.imwrite(str(folder / f"obj{number}__{angle}.png"), drawing(number, angle))
    return folder


def run(folder: Path, keys: str, *arguments: str | Path):
    """Run the experiment with these keys on the photographs of a folder, in one process."""
    file = folder.parent / f"{sha256(keys.encode()).hexdigest()[:8]}.toml"
    file.write_text(keys, encoding="utf-8")
    return command(file, "--data", folder, "--jobs", "1", *arguments)


def command(*arguments: str | Path):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def evaluated(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of one experiment with noise; tests that write to it take a copy."""
    out = tmp_path_factory.mktemp("evaluated") / "out"
    done = run(photographs, QUICK + NOISY, "--out", out)
    assert done.exit_code == 0, done.output
    return out


def results(folder: Path) -> dict:
    found = json.loads((folder / "results.json").read_text())
    found.pop("wall_clock", None)
    return found


def test_evaluation_writes_its_results_in_every_format(photographs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = run(photographs, QUICK, "--noise", "gn", "--methods", "hbr,ahbr,omega-sweep", "--out", out)
    assert done.exit_code == 0, done.output
    assert "AHBR ω = 0.5 at N = 4" in done.output
    assert "McNemar p" in done.output
    found = results(out)
    assert found["settings"]["condition"]["noise"] == "gn:0.012"
    assert found["settings"]["dataset"]["views"] == 48
    assert found["bytes_per_view"] == 54
    hbr = next(method for method in found["methods"] if method["name"] == "hbr")
    assert [point["views"] for point in hbr["curve"]] == [1, 2, 3, 4]
    assert all(point["trials"] == 8 for point in hbr["curve"])
    assert hbr["curve"][-1]["hit_rate_low"] <= hbr["curve"][-1]["hit_rate"] <= hbr["curve"][-1]["hit_rate_high"]
    rows = list(csv.DictReader((out / "results.csv").read_text().splitlines()))
    assert len(rows) == sum(len(method["curve"]) for method in found["methods"])
    assert float(rows[-1]["hit_rate"]) == found["methods"][-1]["curve"][-1]["hit_rate"]
    for name in ("hit-rate", "travel", "pose", "omega-sweep"):
        assert (out / f"{name}.svg").read_text().startswith("<svg")


def test_equal_commands_give_equal_results_with_any_number_of_processes(
    photographs: Path, evaluated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Processes that have imported the program: the tests of `map_in_processes` start others.
    context = server()
    monkeypatch.setattr("rig.core.processes.get_context", lambda _: context)
    assert run(photographs, QUICK + NOISY, "--out", tmp_path / "again", "--jobs", "2").exit_code == 0
    assert results(tmp_path / "again") == results(evaluated)
    assert (tmp_path / "again/hit-rate.svg").read_bytes() == (evaluated / "hit-rate.svg").read_bytes()
    assert run(photographs, QUICK + NOISY, "--out", tmp_path / "other", "--seed", "1").exit_code == 0
    assert results(tmp_path / "other")["methods"] != results(evaluated)["methods"]


def test_report_of_some_objects_searches_among_all(photographs: Path, evaluated: Path, tmp_path: Path) -> None:
    assert run(photographs, QUICK + NOISY + 'report = "3-4"', "--out", tmp_path).exit_code == 0
    whole, part = results(evaluated), results(tmp_path)
    assert part["settings"] == whole["settings"]
    assert (whole["reported"], part["reported"]) == (None, [3, 4])
    assert [method["curve"][0]["trials"] for method in part["methods"]] == [4, 4]
    assert part["methods"][0]["pose_rmse_deg_by_object"] == whole["methods"][0]["pose_rmse_deg_by_object"][2:]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ('noise = "fog"', "noise 'fog' is unknown"),
        ('objects = "3-9"', "has 4"),
        ("speed = 3", "no key speed"),
        ('base = "nothing"', "base 'nothing' is unknown"),
        ("trials =", "cannot be read"),
        ('descriptor = "sift"', "'sift' is unknown"),
        ('methods = "dense"\nenrolled = 12', "queries it needs more"),
        ('change = "mild"', "number of enrolled views"),
        ('base = "photographs-8"\nenrolled = 9', "3 photographs that are not enrolled"),
        ('base = "photographs-8"\npicture = true', "no empty-table image"),
    ],
)
def test_wrong_keys_end_with_a_next_step(photographs: Path, tmp_path: Path, keys: str, message: str) -> None:
    done = run(photographs, keys, "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert message in " ".join(done.output.split())
    assert "Next step" in done.output


def test_damaged_photograph_is_reported_by_its_name(photographs: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(photographs, tmp_path / "photographs")
    broken = folder / "obj3__60.png"
    broken.write_bytes(broken.read_bytes()[:200])
    done = run(folder, QUICK, "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert "obj3__60.png is cut off" in done.output
    done = run(tmp_path / "nowhere", QUICK)
    assert done.exit_code == 2
    assert "nowhere is not a folder" in done.output
    assert "experiment 'nothing' is unknown" in command("nothing", "--data", folder).output


def test_catalog_is_evaluated_if_no_folder_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("rig.toml").write_text('default_bench = "sim"\n[catalog]\npath = "catalog"\n[view]\nroi = [4, 0, 40, 40]\n')
    with Catalog.open("catalog", clock=SystemClock()) as catalog:
        for number, name in enumerate(("mug", "tea box")):
            enrollment = catalog.begin(
                name, planned_azimuth_deg=list(range(0, 360, 30)), provenance=Provenance("bench", {}, {})
            )
            for index in range(12):
                view = View(index=index, azimuth_deg=30.0 * index + 0.25)
                enrollment.add(view, cv2.copyMakeBorder(drawing(number, 30 * index), 0, 0, 4, 4, 0))
            enrollment.finish()
    Path("quick.toml").write_text(QUICK + 'methods = "hbr"')
    done = command("quick.toml", "--jobs", "1", "--out", "out")
    assert done.exit_code == 0, done.output
    assert results(Path("out"))["settings"]["dataset"]["objects"] == ["mug", "tea box"]
    assert results(Path("out"))["methods"][0]["curve"][0]["hit_rate"] > 0.5


@pytest.mark.nightly
@pytest.mark.parametrize("base", ["mild-change", "photographs-8"])
def test_each_object_is_also_searched_for_as_if_it_were_not_enrolled(
    photographs: Path, tmp_path: Path, base: str
) -> None:
    keys = f'base = "{base}"\nobjects = "1-3"\nreport = "2-3"\nenrolled = 4\ntrials = 1'
    done = run(photographs, keys, "--out", tmp_path)
    assert done.exit_code == 0, done.output
    found = results(tmp_path)
    assert all(row["left_out_searches"] == row["searches"] for row in found["rows"])
    assert list(found["searches"]) == ["obj1", "obj2", "obj3"]
    assert "not enrolled: enrolled" in done.output


def test_orientation_errors_come_from_a_calibration(tmp_path: Path) -> None:
    """The errors are the gyro's rotations minus the encoder's, without the moves that were not valid."""
    legs = [(60.0, 60.5, ""), (-60.0, 59.75, ""), (60.0, 90.0, "stopped")]
    moves = [{"leg": {"encoder_deg": a, "gyro_deg": b, "invalid": why}} for a, b, why in legs]
    file = tmp_path / "imu.rotation.json"
    file.write_text(json.dumps({"evidence": {"moves": moves}}))
    assert rotation_errors(str(file)) == (0.5, -0.25)
    shipped_errors = load_experiment("orientation-mpu6050").protocol.rotation_errors_deg
    assert np.std(shipped_errors) == pytest.approx(0.044, abs=0.001)


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"rotation_errors_deg": []}', '{"rotation_errors_deg": ["x"]}'])
def test_unusable_orientation_errors_are_rejected(tmp_path: Path, content: str) -> None:
    file = tmp_path / "errors.json"
    file.write_text(content)
    with pytest.raises(ValueError, match=r"rig calibrate imu"):
        rotation_errors(str(file))


def test_experiments_of_the_results_are_shipped(tmp_path: Path) -> None:
    """Each command of the page names an experiment and options that exist, and no two are equal."""
    page = (Path(__file__).parents[3] / "docs/results.md").read_text(encoding="utf-8")
    commands = re.findall(r"^rig eval (.+)$", page, re.MULTILINE)
    assert len(commands) > 30
    experiments = []
    for words in commands:
        name, *options = words.split()
        pairs = dict(zip(options[::2], options[1::2], strict=True))
        assert pairs.pop("--data", "coil-100") in ("coil-100", "eth-80")
        assert set(pairs) <= {"--noise", "--methods", "--descriptor", "--set"}, words
        pairs.pop("--set", None)
        experiments.append(load_experiment(name, **{key[2:]: value for key, value in pairs.items()}))
    assert len(set(experiments)) == len(experiments)
    assert {words.split()[0] for words in commands} == set(shipped())
