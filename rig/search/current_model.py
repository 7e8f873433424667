"""The model of a catalog, loaded again when the catalog has changed."""

from contextlib import suppress
from dataclasses import replace

from rig.catalog import Catalog
from rig.catalog.local_copy import update_copy
from rig.core.errors import CatalogUnavailable, RigError
from rig.events.events import Note, NoteCode
from rig.search.model import Model, load_model
from rig.search.stopping_rules import FILE


class CurrentModel:
    """Loads the enrolled views, and again after a change of the catalog or of its stopping rule.

    If the catalog is on a server, it brings the local copy up to date, too. While the server does not answer, the
    loaded model stays in use, with a note that says how old it is.

    Attributes
    ----------
    version
        `Catalog.version` of the loaded views; empty before the first call.
    """

    def __init__(self, catalog: Catalog, descriptor: str | None = None) -> None:
        self._catalog = catalog
        self._descriptor = descriptor
        self._loaded_state: object = None
        self._model: Model
        self._seen = ""
        self.version = ""

    def __call__(self) -> Model:
        """Return the model; errors as `load_model`, and `CatalogUnavailable` if none was loaded before."""
        try:
            rules = self._catalog.path / FILE
            changed = self._catalog.database.may_have_changed()
            version = self._catalog.version() if changed or not self.version else self.version
            state = version, rules.stat().st_mtime_ns if rules.exists() else None
            if state != self._loaded_state:
                self._model, self._loaded_state = load_model(self._catalog, descriptor=self._descriptor), state
                self.version = version
                if self._catalog.place.url is not None:
                    with suppress(RigError):  # the copy is for later; the search itself has its model
                        update_copy(self._catalog)
        except CatalogUnavailable:
            if self._loaded_state is None:
                raise
            note = Note(NoteCode.LOCAL_COPY, {"copied_utc": self._seen})
            return replace(self._model, notes=(note, *self._model.notes))
        self._seen = f"{self._catalog.clock.utc():%Y-%m-%d %H:%M:%S} UTC"
        return self._model
