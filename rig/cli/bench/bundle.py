"""The support bundle of `rig doctor --bundle`: files for a person who helps without seeing the bench."""

import json
import platform
import re
from collections.abc import Mapping
from importlib.metadata import distributions
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import ZIP_DEFLATED, ZipFile

from rig.cli.bench.snapshot import take, write_new
from rig.cli.ui.settings import Settings
from rig.core.errors import RigError

if TYPE_CHECKING:
    from rig.doctor.finding import Finding

HIDDEN = "***"
_NAMES = r"[\w.-]*(?:password|passwd|token|secret|signature|credential|key)"
_SECRET_NAME = re.compile(_NAMES, re.IGNORECASE)
_IN_URL = re.compile(r"(://[^\s/:@\"']*):[^\s\"']*@")
_IN_QUERY = re.compile(rf"([?&;]{_NAMES}=)[^&;\s\"']+", re.IGNORECASE)
_IN_TOML = re.compile(rf"([\"']?\b{_NAMES}[\"']?\s*=\s*)(?:\"[^\"\n]*\"|'[^'\n]*'|[^\s,}}\]]+)", re.IGNORECASE)


def write_bundle(settings: Settings, file: Path, findings: "list[Finding]", *, picture: bool) -> None:
    """Write findings, log, configuration and versions into a ZIP file, and with ``picture`` one image of the camera.

    Passwords and tokens are replaced by `HIDDEN`, also those in URLs. What cannot be read is left out; the list
    ``missing`` in ``versions.json`` has the reason.

    Raises
    ------
    UsageError
        The file exists or cannot be written.
    """
    from rig.config.values import default_path
    from rig.events.events import plain
    from rig.safety.saved_state import FileStore
    from rig.views.image_files import encode

    contents: dict[str, bytes] = {"findings.json": _json([finding.as_dict() for finding in findings])}
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
        parts["rig.toml"] = lambda: _IN_TOML.sub(rf'\1"{HIDDEN}"', _hidden(path.read_text("utf-8"))).encode()
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
    return json.dumps(_hidden(value), indent=1, default=str).encode()


def _hidden(value: Any) -> Any:
    """Return a value with `HIDDEN` in the place of passwords and tokens."""
    if isinstance(value, Mapping):
        return {
            key: HIDDEN if item and isinstance(item, str) and _SECRET_NAME.fullmatch(str(key)) else _hidden(item)
            for key, item in value.items()
        }
    if isinstance(value, list | tuple):
        return [_hidden(item) for item in value]
    if isinstance(value, str):
        return _IN_URL.sub(rf"\1:{HIDDEN}@", _IN_QUERY.sub(rf"\1{HIDDEN}", value))
    return value
