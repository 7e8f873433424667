"""The configuration `rig.toml`: all keys with unit, range and default."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

import platformdirs
from pydantic import Field, ValidationInfo, field_validator

from rig.config.catalog_place import CatalogPlace
from rig.config.device_sections import CameraConfig, CameraTimeConfig, HeadConfig, ImuConfig, ServoConfig
from rig.config.section import Section
from rig.config.table_sections import MarkConfig, SafetyConfig, TableConfig
from rig.config.values import APP, read_values, validate
from rig.core.masking import masked

Fraction = Annotated[float, Field(ge=0, le=1)]
Mode = Literal["auto", "step", "fly"]
"""Whether views are taken at rest (step) or while the table rotates (fly)."""


class ViewConfig(Section):
    """Quality that a view needs."""

    roi: tuple[int, int, int, int] | None = Field(
        (80, 0, 480, 480),
        description="x, y, width and height of the image region that is described; none: the whole frame; the default "
        "follows the frame: the largest square in its middle",
    )
    min_sharpness: float = Field(
        3.0, ge=0, le=1e6, description="smallest variance of the Laplacian of the region in grey"
    )
    max_dark: Fraction = Field(0.95, description="largest part of pixels below level 8")
    max_saturated: Fraction = Field(0.25, description="largest part of pixels at level 255")
    min_mean: float = Field(4.0, ge=0, le=255, description="smallest mean level")
    max_noise: float = Field(  # half a frame of random bytes has more
        0.3,
        ge=0,
        le=10,
        description="largest share of noise in the differences of neighbouring pixels; 1 accepts even a frame of noise",
    )
    retakes: int = Field(3, ge=0, le=20, description="further frames before a view fails; repeated ones do not count")
    max_smear_px: float = Field(
        4.0,
        ge=0.1,
        le=100,
        description="largest motion during an exposure at the edge of the region, of views that are taken in motion",
    )
    max_angle_sigma_deg: float = Field(
        0.2, ge=0.01, le=10, description="largest standard uncertainty of the angle of a view that is taken in motion"
    )


class CatalogConfig(Section):
    """Where enrolled objects are stored."""

    path: Path | None = Field(
        None, description="folder of the catalog; none: one catalog for each bench in the user's data folder"
    )
    url: str | None = Field(
        None,
        description="PostgreSQL database of a catalog that several benches share: "
        "postgresql+psycopg://USER@HOST/DATABASE, with the password in ~/.pgpass; none: an SQLite file in the folder",
    )
    images: str | None = Field(
        None, description="folder or object store of the images, such as s3://BUCKET/FOLDER; none: the folder"
    )

    @field_validator("images")
    @classmethod
    def _shared_images(cls, images: str | None, others: ValidationInfo) -> str | None:
        if images is not None and others.data.get("url") is None:
            raise ValueError("is for a catalog with a url; an SQLite catalog has its images in its folder")
        return images


class EnrollConfig(Section):
    """How an object is enrolled."""

    views: int = Field(72, ge=4, le=720, description="views in a revolution")
    mode: Mode = Field(
        "auto",
        description="fly: the views are taken while the table rotates; step: at rest; auto: fly for trays if the "
        "camera's time is calibrated",
    )


class IdentifyConfig(Section):
    """How an object is identified."""

    strategy: str | None = Field(
        None,
        description="strategy that chooses the next view; none: dense; ahbr is the paper's, hmm its successor",
    )
    mode: Mode = Field(
        "auto",
        description="fly: frames count while the table rotates; step: only at rest; auto: fly if the camera's time is "
        "calibrated (dense only)",
    )
    max_views: int = Field(8, ge=1, le=72, description="largest number of views")
    min_views: int = Field(
        2,
        ge=1,
        le=72,
        validate_default=True,
        description="smallest number of views before a decision; dense and hmm use their own rules instead",
    )
    first_step_deg: float = Field(
        90.0, ge=-180, le=180, description="rotation between the first two views; positive is counter-clockwise"
    )
    omega: float = Field(0.5, ge=0, le=100, description="weight of the orientation term")
    list_length: int = Field(10, ge=1, le=1000, description="views on a retrieval list")
    extension: Literal["visual", "orient", "orient_all"] = Field(
        "orient_all", description="how missing views are filled in"
    )
    record: Literal["image", "answer", "none"] = Field(
        "image",
        description="what the catalog records of each answer: with the image of the first view, without, or nothing",
    )
    margin: Fraction = Field(
        0.02,
        description="stop when the best score is certain to lead by this margin for each view; not for dense and hmm",
    )
    repeatability: Fraction = Field(
        0.97, description="lowest similarity of the same view after placing the object again, from calibration"
    )
    min_score: Fraction | None = Field(
        None,
        description="an object with a lower score per view is unknown; none: from the enrolled views; not for dense",
    )

    @field_validator("min_views")
    @classmethod
    def _views_in_order(cls, min_views: int, others: ValidationInfo) -> int:
        max_views = others.data.get("max_views", min_views)
        if min_views > max_views:
            raise ValueError(f"must not be above max_views, which is {max_views}")
        return min_views


class ServeConfig(Section):
    """What the page of the bench shows of other benches."""

    benches: dict[str, str] = Field(
        default_factory=dict,
        description="benches of the page Benches: the address of the server of each, by name; a token stands before "
        "the host, as in token:TOKEN@left.local",
    )

    find: bool = Field(
        False, description="also show benches that announce themselves in the local network; needs hbr-rig[mdns]"
    )

    @field_validator("benches")
    @classmethod
    def _addresses(cls, benches: dict[str, str]) -> dict[str, str]:
        for name, address in benches.items():
            try:
                parts = urlsplit(address)
                is_server = parts.scheme in ("http", "https") and parts.hostname and parts.port != 0
                is_server = is_server and parts.path in ("", "/") and not (parts.query or parts.fragment)
            except ValueError:  # the port is no number
                is_server = False
            if not is_server:
                raise ValueError(f"{name} needs an address such as http://left.local:8420 (found {masked(address)!r})")
        return benches


class RigConfig(Section):
    """Everything in `rig.toml`."""

    default_bench: str = Field("hardware", description="bench that is opened without --bench")
    state_dir: Path | None = Field(
        None, description="folder of the benches' states, with one folder for each bench; none: the user's state folder"
    )
    calibration_dir: Path | None = Field(
        None, description="folder of the calibrations, with one folder for each bench; none: the user's data folder"
    )
    trace: Path | None = Field(
        None, description="new file that records what the bench exchanges with its devices; none: no recording"
    )
    notify_command: list[str] = Field(
        default_factory=list,
        description="program and its arguments, run with JSON on stdin when a job has ended or a fault was latched; "
        "no shell reads it",
    )
    servo: ServoConfig = ServoConfig()
    table: TableConfig = TableConfig()
    mark: MarkConfig = MarkConfig()
    safety: SafetyConfig = SafetyConfig()
    imu: ImuConfig = ImuConfig()
    head: HeadConfig = HeadConfig()
    camera: CameraConfig = CameraConfig()
    camera_time: CameraTimeConfig = CameraTimeConfig()
    view: ViewConfig = Field(ViewConfig(), validate_default=True)
    catalog: CatalogConfig = CatalogConfig()
    enroll: EnrollConfig = EnrollConfig()
    identify: IdentifyConfig = IdentifyConfig()
    serve: ServeConfig = ServeConfig()
    bench: dict[str, dict[str, Any]] = Field(
        default_factory=dict, description="options of each bench, by name: [bench.sim]"
    )

    @field_validator("view")
    @classmethod
    def _region_within_frame(cls, view: ViewConfig, others: ValidationInfo) -> ViewConfig:
        camera = others.data.get("camera")
        if camera is not None and "roi" not in view.model_fields_set:
            side = min(camera.width, camera.height)
            square = (camera.width - side) // 2, (camera.height - side) // 2, side, side
            # It stays unset, so that a calibration can set it.
            return ViewConfig.model_construct(view.model_fields_set, **{**dict(view), "roi": square})
        if camera is not None and view.roi is not None:
            x, y, width, height = view.roi
            if min(x, y) < 0 or min(width, height) < 1 or x + width > camera.width or y + height > camera.height:
                raise ValueError(
                    f"roi {list(view.roi)} is not within the camera's frame of {camera.width}x{camera.height}"
                )
        return view

    def with_max_views(self, max_views: int) -> "RigConfig":
        """Return this configuration with another largest number of views of a search; the smallest is not larger."""
        identify = self.identify
        limits = {"max_views": max_views, "min_views": min(identify.min_views, max_views)}
        return self.model_copy(update={"identify": identify.model_copy(update=limits)})

    def catalog_path(self, bench_name: str) -> Path:
        """Return the catalog's folder; by default each bench has its own: simulated and real views do not mix."""
        return self.catalog.path or Path(platformdirs.user_data_dir(APP)) / bench_name

    def catalog_place(self, bench_name: str) -> CatalogPlace:
        """Return where the catalog of the bench is."""
        return CatalogPlace(self.catalog_path(bench_name), self.catalog.url, self.catalog.images)

    def calibration_path(self, bench_name: str) -> Path:
        """Return the folder of the bench's calibrations."""
        return (self.calibration_dir or Path(platformdirs.user_data_dir(APP)) / "calibration") / bench_name

    def state_path(self, bench_name: str) -> Path:
        """Return the folder of the bench's state: revolutions, latched fault, and the program that uses it."""
        return (self.state_dir or Path(platformdirs.user_state_dir(APP))) / bench_name


def load_config(path: Path | None = None, overrides: Iterable[str] = (), *, search: bool = True) -> RigConfig:
    """Read a configuration file and apply ``overrides`` (``"section.key=value"``, values in TOML's notation).

    Without ``path`` it is the file in force, if any; with ``search`` false there is no file.

    Raises `ConfigError`: the file is missing, is not TOML, or has mistakes; the evidence lists all of them with their
    keys.
    """
    read = read_values(path, overrides, search=search)
    where = str(read.path) if read.path else "the command line"
    return validate(RigConfig, read.values, where=where, places=read.places)
