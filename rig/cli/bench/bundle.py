"""The support bundle of `rig doctor --bundle`: files for a person who helps without seeing the bench."""

import json
import platform
from importlib.metadata import distributions
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

from rig.cli.bench.snapshot import take, write_new
from rig.cli.ui.settings import Settings
from rig.config.values import default_path
from rig.core.errors import RigError
from rig.core.json_form import plain
from rig.core.masking import masked
from rig.safety.saved_state import FileStore
from rig.views.image_files import encode


def write_bundle(settings: Settings, file: Path, findings: list[dict[str, Any]], *, picture: bool) -> None:
    """Write findings, log, configuration and versions into a ZIP file, and with ``picture`` one image of the camera.

    Passwords and tokens are masked. What cannot be read is left out; the list ``missing`` in ``versions.json`` has the
    reason.

    Raises
    ------
    UsageError
        The file exists or cannot be written.
    """
    contents: dict[str, bytes] = {"findings.json": _json(findings)}
    missing: list[str] = []

    def log() -> bytes:
        with settings.open_catalog(read_only=True) as catalog:
            return _json([plain(entry) | {"time_utc": entry.time_utc.isoformat()} for entry in catalog.log()])

    def state() -> bytes:
        return _json(FileStore(settings.load().state_path(settings.bench_name)).load().model_dump(mode="json"))

    parts = {
        "configuration.json": lambda: _json(settings.load().model_dump(mode="json")),
        "state.json": state,
        "log.json": log,
    }
    if path := settings.config or default_path():
        parts["rig.toml"] = lambda: str(masked(path.read_text("utf-8"))).encode()
    if picture:
        parts["camera.png"] = lambda: encode(take(settings)[0].image_bgr)
    for name, read in parts.items():
        try:
            contents[name] = read()
        except (RigError, OSError) as error:
            missing.append(f"{name}: {error}")
    versions = {one.metadata["Name"]: one.version for one in distributions()}
    system = {"python": platform.python_version(), "system": platform.platform(), "machine": platform.machine()}
    contents["versions.json"] = _json({**system, "packages": versions, "missing": missing})
    packed = BytesIO()
    with ZipFile(packed, "w", ZIP_DEFLATED) as bundle:
        for name, content in contents.items():
            bundle.writestr(name, content)
    write_new(file, packed.getvalue())


def _json(value: Any) -> bytes:
    return json.dumps(masked(value), indent=1, default=str).encode()
