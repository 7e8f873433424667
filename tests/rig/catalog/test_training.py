"""Training sets: COCO and YOLO with masks of the objects, divided into parts, and imported without loss."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from typer.testing import CliRunner

from rig.catalog import Catalog, Provenance, View
from rig.catalog.describing import described
from rig.catalog.exchange.training import Annotations, TrainingExport, write_training
from rig.catalog.transfer import CatalogSource
from rig.catalog.verify import verify
from rig.cli.main import app
from rig.core.errors import ExportFailed
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import PROVENANCE, finished, plan, without_waiting
from tests.rig.catalog.exchange.exchange_samples import facts

REGION = (16, 0, 160, 144)
VIEWS = 4
AREA = np.pi * 28 * 44


def scene(index: int | None, colour: tuple[int, int, int] = (40, 60, 200)) -> NDArray[np.uint8]:
    """Return a plain frame with an ellipse; for None without it."""
    frame = np.random.default_rng(index or 0).normal(128, 1.5, (144, 192, 3)).clip(0, 255).astype(np.uint8)
    if index is not None:
        cv2.ellipse(frame, (80 + 2 * index, 72), (28, 44), 0, 0, 360, colour, -1)
    return frame


def enroll(
    catalog: Catalog,
    name: str,
    frames: list[NDArray[np.uint8]],
    region: Any = None,
    table: Any = None,
    provenance: Provenance = PROVENANCE,
) -> None:
    azimuths_deg = plan(len(frames))
    enrollment = catalog.begin(
        name, planned_azimuth_deg=azimuths_deg, provenance=provenance, label="toys", empty_table=table
    )
    for index, frame in enumerate(frames):
        enrollment.add(View(index=index, azimuth_deg=azimuths_deg[index], region=region), frame)
    enrollment.finish()


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return two objects with 4 views each: one with an empty-table image and a region, one without both."""
    path = tmp_path_factory.mktemp("training") / "catalog"
    with pytest.MonkeyPatch.context() as patch, Catalog.open(path, clock=VirtualClock()) as catalog:
        without_waiting(patch)
        enroll(catalog, "mug", [scene(i) for i in range(VIEWS)], REGION, scene(None))
        enroll(catalog, 'tin: "7"', [*(scene(i, (200, 90, 30)) for i in range(VIEWS - 1)), scene(None)])
    return path


@pytest.fixture
def catalog(sample: Path) -> Iterator[Catalog]:
    with Catalog.open(sample, clock=VirtualClock(), read_only=True) as opened:
        yield opened


@pytest.fixture(scope="module")
def coco(sample: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TrainingExport]:
    folder = tmp_path_factory.mktemp("coco") / "out"
    with pytest.MonkeyPatch.context() as patch, Catalog.open(sample, clock=VirtualClock(), read_only=True) as opened:
        without_waiting(patch)
        return folder, export(opened, folder)


def export(catalog: Catalog, folder: Path, form: Annotations = Annotations.COCO) -> TrainingExport:
    return finished(write_training(folder, CatalogSource(catalog), form, jobs=1))


def parts_of(folder: Path) -> dict[str, Any]:
    return {path.stem.partition("_")[2]: json.loads(path.read_text()) for path in (folder / "annotations").iterdir()}


def test_coco_has_the_stored_boxes_and_azimuths(catalog: Catalog, coco: tuple[Path, TrainingExport]) -> None:
    folder, done = coco
    assert (done.objects, done.views, done.without_mask) == (2, {"train": 2 * VIEWS, "val": 0, "test": 0}, 1)
    content = parts_of(folder)["train"]
    assert [(one["name"], one["supercategory"]) for one in content["categories"]] == [
        ("mug", "toys"),
        ('tin: "7"', "toys"),
    ]
    views: list[tuple[View, dict[str, Any]]] = []
    for name in ("mug", 'tin: "7"'):
        found = catalog.object(name)
        assert found.complete is not None
        views += zip(found.views, described(catalog.database, found.complete, name).segmentation, strict=True)
    for (view, evidence), picture, annotation in zip(views, content["images"], content["annotations"], strict=True):
        assert (folder / picture["file_name"]).read_bytes() == catalog.image_path(view.image).read_bytes()
        assert picture["azimuth_deg"] == annotation["azimuth_deg"] == view.azimuth_deg
        assert (picture["width"], picture["height"]) == (192, 144)
        stored = evidence["box_px"]
        x0, y0, *_ = view.region or (0, 0)
        expected = [0, 0, 192, 144] if stored is None else [stored[0] + x0, stored[1] + y0, *stored[2:]]
        assert annotation["bbox"] == expected
        assert annotation["iscrowd"] == (stored is None)
        assert annotation["area"] == sum(annotation["segmentation"]["counts"][1::2])
        assert stored is None or annotation["area"] == pytest.approx(AREA, rel=0.15)


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # of pycocotools itself
def test_pycocotools_reads_the_masks(coco: tuple[Path, TrainingExport]) -> None:
    reader = pytest.importorskip("pycocotools.coco", reason="pycocotools is not installed")
    read = reader.COCO(coco[0] / "annotations" / "instances_train.json")
    for annotation in read.loadAnns(read.getAnnIds(iscrowd=False)):
        mask = read.annToMask(annotation)
        (picture,) = read.loadImgs(annotation["image_id"])
        frame = cv2.imread(str(coco[0] / picture["file_name"]))
        really = np.abs(frame.astype(int) - 128).max(axis=2) > 30
        assert (mask & really).sum() / (mask | really).sum() > 0.9
        x, y, width, height = annotation["bbox"]
        assert not mask[:y, :].any()
        assert mask[y : y + height, x : x + width].sum() == mask.sum() == annotation["area"]
    assert len(read.getAnnIds(iscrowd=True)) == 1


def test_import_restores_everything(catalog: Catalog, coco: tuple[Path, TrainingExport], tmp_path: Path) -> None:
    words = ["import", str(coco[0]), "--bench", "sim", "--set", f"catalog.path={tmp_path / 'new'}"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    with Catalog.open(tmp_path / "new", clock=VirtualClock()) as new:
        assert [facts(one) for one in CatalogSource(new).items()] == [
            facts(one) for one in CatalogSource(catalog).items()
        ]
        assert finished(verify(new)).findings == ()


def test_image_that_two_objects_share_is_annotated_once(tmp_path: Path) -> None:
    with Catalog.open(tmp_path / "catalog", clock=VirtualClock()) as shared:
        enroll(shared, "mug", [scene(i) for i in range(VIEWS)])
        enroll(shared, "cup", [scene(i) for i in range(1, VIEWS + 1)])
        done = export(shared, tmp_path / "out")
    assert (done.objects, sum(done.views.values())) == (2, VIEWS + 1)
    names = [one["file_name"] for content in parts_of(tmp_path / "out").values() for one in content["images"]]
    assert len(names) == len(set(names)) == VIEWS + 1


def test_views_of_each_object_are_divided(tmp_path: Path) -> None:
    with Catalog.open(tmp_path / "catalog", clock=VirtualClock()) as catalog:
        enroll(catalog, "mug", [scene(i) for i in range(20)])
        enroll(catalog, "tin", [scene(i, (200, 90, 30)) for i in range(5)])
        done = export(catalog, tmp_path / "out")
    assert done.views == {"train": 20, "val": 3, "test": 2}
    places = {
        part: [one["azimuth_deg"] for one in content["images"]] for part, content in parts_of(tmp_path / "out").items()
    }
    assert places["val"] == [plan(20)[4], plan(20)[14], plan(5)[4]]
    assert places["test"] == [plan(20)[9], plan(20)[19]]


def test_yolo_has_outlines_and_leaves_out_views_without_an_object(catalog: Catalog, tmp_path: Path) -> None:
    done = export(catalog, tmp_path / "out", Annotations.YOLO)
    assert done.without_mask == 1
    about = yaml.safe_load((tmp_path / "out" / "data.yaml").read_text())
    assert about == {"train": "train.txt", "val": "train.txt", "names": {0: "mug", 1: 'tin: "7"'}}
    names = (tmp_path / "out" / "train.txt").read_text().split()
    assert len(names) == 2 * VIEWS - 1
    first = {view.image for view in catalog.object("mug").views}
    for name in names:
        assert (tmp_path / "out" / name).is_file()
        label = (tmp_path / "out" / name.replace("/images/", "/labels/")).with_suffix(".txt").read_text().split()
        corners = np.array(label[1:], float).reshape(-1, 2) * (192, 144)
        assert label[0] == ("0" if Path(name).name in first else "1")
        assert cv2.contourArea(corners.astype(np.float32)) == pytest.approx(AREA, rel=0.15)


def test_interrupted_or_failed_export_leaves_nothing(catalog: Catalog, tmp_path: Path) -> None:
    job = write_training(tmp_path / "out", CatalogSource(catalog), Annotations.COCO, jobs=1)
    next(job)
    job.close()
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "diary.txt").touch()
    with pytest.raises(ExportFailed, match="exists already"):
        export(catalog, tmp_path / "full")
    assert [path.name for path in tmp_path.rglob("*")] == ["full", "diary.txt"]


def test_catalog_without_complete_enrollments_gives_no_training_set(tmp_path: Path) -> None:
    with Catalog.open(tmp_path / "catalog", clock=VirtualClock()) as empty:
        empty.begin("mug", planned_azimuth_deg=plan(2), provenance=PROVENANCE)
        with pytest.raises(ExportFailed, match="no complete enrollments"):
            export(empty, tmp_path / "out")
    assert not (tmp_path / "out").exists()
