"""The place of a catalog: a folder alone, or a folder of this computer with a database server and a store of images."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rig.core.masking import masked

DATABASE_NAME: Final = "catalog.sqlite"


@dataclass(frozen=True, slots=True)
class CatalogPlace:
    """Place of a catalog."""

    path: Path
    """Folder on this computer. Without ``url`` it holds the whole catalog, else the journal and the local copy."""
    url: str | None = None
    """URL of a PostgreSQL database, ``postgresql+psycopg://HOST/DATABASE``; None for an SQLite file in ``path``."""
    images: str | None = None
    """Folder or URL (``s3://BUCKET/FOLDER``) of the images; None for ``path``."""

    @classmethod
    def of(cls, place: "str | os.PathLike[str] | CatalogPlace") -> "CatalogPlace":
        """Return the place of a catalog in a folder; a place is returned unchanged."""
        found = place if isinstance(place, CatalogPlace) else cls(Path(place))
        return cls(found.path.expanduser().absolute(), found.url, found.images)

    @property
    def database_file(self) -> Path:
        return self.path / DATABASE_NAME

    @property
    def copy_folder(self) -> Path:
        """Folder of the local copy of a catalog on a server (`rig.catalog.copying`)."""
        return self.path / "local-copy"

    def may_exist(self) -> bool:
        """Return whether there is a database file. Whether a server has a catalog is not known before it is asked."""
        return self.url is not None or self.database_file.exists()

    def __str__(self) -> str:
        return str(self.path) if self.url is None else str(masked(self.url))
