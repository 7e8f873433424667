"""The dimensions of the table: ``table.toml``, which the printed parts in docs/hardware have, too."""

import tomllib
from importlib.resources import files
from typing import Any, Final

TABLE: Final[dict[str, Any]] = tomllib.loads(files("sim").joinpath("table.toml").read_text("utf-8"))
