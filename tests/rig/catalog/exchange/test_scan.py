"""Scans: the poses agree with the simulator's truth, COLMAP reads them, and the images have EXIF."""

import json
from collections.abc import Iterator
from functools import cache
from math import radians
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from calibration import camera_model, table_axis
from calibration.board_views import STANDS
from rig.calibrations import CalibrationResult
from rig.catalog import Catalog, Provenance, View
from rig.catalog.exchange.scan import ScanFormat, write_scan
from rig.catalog.transfer import CatalogSource
from rig.core.errors import ExportFailed
from rig.views.charuco_board import CharucoBoard
from sim.calibration_board import BoardOnPlatter, home_mark
from sim.clock import VirtualClock
from sim.objects.solid import empty_platter
from tests.calibration.board_bench import noise, optics, seen
from tests.rig.catalog.catalog_samples import without_waiting

TABLE_DEG = (0.0, -100.0, 30.5, 215.0)
TRUE = optics(0)


@cache
def results() -> tuple[CalibrationResult, CalibrationResult]:
    when = VirtualClock().utc()
    views = seen(TRUE, tuple(STANDS), camera_model.ANGLES_DEG[::2])
    camera = camera_model.evaluate(views, CharucoBoard(), (640, 480)).result(
        when_utc=when, reference="", operator="", device={}
    )
    views = seen(TRUE, table_axis.STANDS, table_axis.ANGLES_DEG[::2])
    return camera, table_axis.evaluate(views, CharucoBoard(), camera).result(
        when_utc=when, reference="", operator="", device={}
    )


def enroll(catalog: Catalog, name: str, pictures: dict[float, Any], calibrated: bool = True) -> None:
    """Store pictures, by the angle of the table, as an enrollment with calibrations stores them."""
    ids = [one.id for one in results()] if calibrated else []
    provenance = Provenance(
        *("sim", {"camera": {"name": "Acme Eye 3"}}, {"calibrations": ids}, "hbr-rig 0.1.0"),
    )
    views = sorted((-angle % 360, picture) for angle, picture in pictures.items())
    enrollment = catalog.begin(name, planned_azimuth_deg=[azimuth for azimuth, _ in views], provenance=provenance)
    for index, (azimuth_deg, picture) in enumerate(views):
        enrollment.add(View(index=index, azimuth_deg=azimuth_deg), picture)
    enrollment.finish()


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Iterator[CatalogSource]:
    """Return an object with a view from each of `TABLE_DEG`."""
    folder = tmp_path_factory.mktemp("scans") / "catalog"
    with pytest.MonkeyPatch.context() as patch, Catalog.open(folder, clock=VirtualClock()) as catalog:
        without_waiting(patch)
        frames = {}
        for index, table_deg in enumerate(sorted(TABLE_DEG, key=lambda angle: -angle % 360)):
            frame = frames[table_deg] = np.full((480, 640, 3), 128, np.uint8)
            cv2.ellipse(frame, (320, 240 + index), (60, 90), 0, 0, 360, (40, 60, 200), -1)
        enroll(catalog, "mug", frames)
        enroll(catalog, "jug", frames, calibrated=False)
        yield CatalogSource(catalog, ["mug"])


def true_pixels(table_deg: float, points_mm: Any) -> Any:
    """Return where the simulated camera sees points of the platter."""
    rotation, translation = TRUE.to_camera(table_deg)
    vector = cv2.Rodrigues(rotation)[0]
    return cv2.projectPoints(points_mm, vector, translation, TRUE.matrix, np.array(TRUE.distortion))[0].reshape(-1, 2)


def points_mm() -> Any:
    """Return points of an object on the platter, in the platter's frame."""
    around = np.radians(np.arange(0, 360, 30.0))
    x, y, z = np.cos(around), np.sin(around), np.ones_like(around)
    return np.concatenate([np.column_stack([60 * x, 60 * y, height * z]) for height in (0.0, 60.0, 120.0)])


def test_poses_are_those_of_the_camera_and_reproject_the_truth_within_a_pixel(source, tmp_path):
    assert write_scan(tmp_path / "scan", source, ScanFormat.NERFSTUDIO, results()) == len(TABLE_DEG)
    frames = json.loads((tmp_path / "scan" / "transforms.json").read_text())["frames"]
    # Reconstruct points of the object from where the simulated camera sees them, with the cameras of the scan.
    equations, cameras = [], []
    for table_deg, frame in zip(sorted(TABLE_DEG, key=lambda a: -a % 360), frames, strict=True):
        pose = np.linalg.inv(np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0]))
        matrix = np.array([[frame["fl_x"], 0, frame["cx"] - 0.5], [0, frame["fl_y"], frame["cy"] - 0.5], [0, 0, 1]])
        distortion = np.array([frame[name] for name in ("k1", "k2", "p1", "p2")])
        truth = true_pixels(table_deg, points_mm())
        rays = cv2.undistortPoints(truth[:, None], matrix, distortion)[:, 0]
        equations.append(rays[:, :, None] * pose[2] - pose[None, :2])
        cameras.append((pose, matrix, distortion, truth))
    stacked = np.concatenate(equations, axis=1)
    found_mm = np.array([np.linalg.lstsq(one[:, :3], -one[:, 3], rcond=None)[0] for one in stacked])
    for pose, matrix, distortion, truth in cameras:
        vector = cv2.Rodrigues(pose[:3, :3])[0]
        seen_px = cv2.projectPoints(found_mm, vector, pose[:3, 3], matrix, distortion)[0].reshape(-1, 2)
        assert np.linalg.norm(seen_px - truth, axis=1).max() < 1.0
    sizes_mm = [np.linalg.norm(one - one[:1], axis=1)[1:] for one in (found_mm, points_mm())]
    assert sizes_mm[0] == pytest.approx(sizes_mm[1], rel=0.01)
    # Each frame has its image, and the mask of the object in it.
    for frame in frames:
        image, mask = (cv2.imread(str(tmp_path / "scan" / frame[key])) for key in ("file_path", "mask_path"))
        assert image.shape == mask.shape == (480, 640, 3)
        drawn = cv2.ellipse(np.zeros_like(mask), (320, 240), (60, 90), 0, 0, 360, (255, 255, 255), -1)
        assert np.count_nonzero(mask & drawn) > 0.8 * np.count_nonzero(mask | drawn)
        # z is up along the axis, and the camera stands at its azimuth: at 0 it is at -y; it grows counter-clockwise.
        x, y, z = np.array(frame["transform_matrix"])[:3, 3]
        azimuth = sorted(-angle % 360 for angle in TABLE_DEG)[int(Path(frame["file_path"]).stem)]
        off = radians(np.degrees(np.arctan2(y, x)) + 90 - azimuth)
        assert abs(np.arctan2(np.sin(off), np.cos(off))) < radians(5)
        assert z > 0


def test_colmap_reconstructs_boards_within_a_pixel(source, tmp_path):
    """Boards, because the simulator draws them through the lens, and all other objects in parallel projection."""
    pycolmap = pytest.importorskip("pycolmap")
    pictures = {}
    for table_deg in np.arange(-40.0, 41.0, 20.0):
        picture = empty_platter()
        for board in (BoardOnPlatter(CharucoBoard(), TRUE, tilt_deg=4.0), home_mark(TRUE)):
            board.draw(picture, table_deg)
        pictures[table_deg] = np.clip(picture + noise(), 0, 255).astype(np.uint8)
    enroll(source.catalog, "boards", pictures)
    scan, database, points = (tmp_path / name for name in ("scan", "database", "points"))
    write_scan(scan, CatalogSource(source.catalog, ["boards"]), ScanFormat.COLMAP, results())
    read = pycolmap.Reconstruction(str(scan / "sparse" / "0"))
    (camera,) = read.cameras.values()
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model, reader.camera_params = camera.model.name, camera.params_to_string()
    reader.mask_path = str(scan / "masks")
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = 1  # images get their numbers in their order
    one_camera = pycolmap.CameraMode.SINGLE
    pycolmap.extract_features(
        database, scan / "images", camera_mode=one_camera, reader_options=reader, extraction_options=extraction
    )
    pycolmap.match_exhaustive(database)
    points.mkdir()
    found = pycolmap.triangulate_points(read, database, scan / "images", points)
    assert found.num_points3D() > 200
    assert found.compute_mean_reprojection_error() < 0.5
    # They are where the boards stand: the upright one leans by 4°, and the card of the home mark is in front of it.
    y, z = np.array([point.xyz[1:] for point in found.points3D.values()]).T
    on_board = np.abs(y - (z - 75.0) * np.tan(radians(4.0))) < 2.0
    on_card = ~on_board & (y < -40.0)
    assert np.mean(on_board | on_card) > 0.9
    assert on_board.sum() > 100
    assert on_card.sum() > 10


def test_colmap_reads_the_scan(source, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    write_scan(tmp_path / "scan", source, ScanFormat.COLMAP, results())
    write_scan(tmp_path / "other", source, ScanFormat.NERFSTUDIO, results())
    read = pycolmap.Reconstruction(str(tmp_path / "scan" / "sparse" / "0"))
    frames = json.loads((tmp_path / "other" / "transforms.json").read_text())["frames"]
    assert read.num_images() == len(frames)
    (camera,) = read.cameras.values()
    assert list(camera.params[:4]) == pytest.approx([frames[0][name] for name in ("fl_x", "fl_y", "cx", "cy")])
    for image in read.images.values():
        (frame,) = (one for one in frames if Path(one["file_path"]).name == image.name)
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        to_camera = np.linalg.inv(np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0]))
        assert pose.matrix() == pytest.approx(to_camera[:3], abs=1e-6)
    exif = pycolmap.Bitmap.read(str(tmp_path / "scan" / "images" / "000.png"), True)
    assert exif is not None


def test_colmap_files_name_one_camera_and_each_image_with_its_exif(source, tmp_path):
    write_scan(tmp_path / "scan", source, ScanFormat.COLMAP, results())
    folder = tmp_path / "scan" / "sparse" / "0"
    assert (folder / "cameras.txt").read_text().startswith("1 OPENCV 640 480 ")
    lines = (folder / "images.txt").read_text().splitlines()[1:]
    assert [line.split()[-1] for line in lines[::2]] == [f"{index:03}.png" for index in range(len(TABLE_DEG))]
    assert set(lines[1::2]) == {""}
    assert sorted(path.name for path in (tmp_path / "scan" / "masks").iterdir())[0] == "000.png.png"
    image_module = pytest.importorskip("PIL.Image")
    with image_module.open(tmp_path / "scan" / "images" / "001.png") as picture:
        exif, pixels = picture.getexif(), np.asarray(picture)[..., ::-1]
    (item,) = source.items()
    assert np.array_equal(pixels, source.catalog.database.images.pixels(item.enrollment.views[1].image))
    own = exif.get_ifd(0x8769)
    assert (exif[0x010F], exif[0x0110], exif[0x0131]) == ("Acme", "Acme Eye 3", "hbr-rig 0.1.0")
    assert "azimuth 100.000 deg" in exif[0x010E]
    assert json.loads(own[0x9286][8:]) == {"azimuth_deg": 100.0}
    focal_px = float(own[0x920A]) * float(own[0xA20E]) / 10
    assert focal_px == pytest.approx(results()[1].evidence["lens"][0], rel=1e-4)


def test_scan_needs_one_object_with_stored_calibrations(source, tmp_path):
    with pytest.raises(ExportFailed, match="2 were chosen"):
        write_scan(tmp_path / "scan", CatalogSource(source.catalog, ["mug", "jug"]), ScanFormat.COLMAP, results())
    with pytest.raises(ExportFailed, match="without the calibration 'camera'") as raised:
        write_scan(tmp_path / "scan", CatalogSource(source.catalog, ["jug"]), ScanFormat.COLMAP, results())
    assert raised.value.next_step
    with pytest.raises(ExportFailed, match="calibration 'table'"):
        write_scan(tmp_path / "scan", source, ScanFormat.COLMAP, results()[:1])
    assert not (tmp_path / "scan").exists()
