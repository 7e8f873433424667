"""The model of a catalog, loaded again when the catalog has changed."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Self

from rig.catalog import Catalog
from rig.catalog.jobs import JobProgress
from rig.catalog.shared import Attempts, update_copy
from rig.core.errors import CatalogUnavailable, RigError
from rig.events.events import Note, NoteCode
from rig.search.model import Model, load_model
from rig.search.stopping_rules import FILE


@dataclass(eq=False)
class CurrentModel:
    """Loads the enrolled views, and again after a change of the catalog or of its stopping rule.

    If the catalog is on a server, it brings the local copy up to date, too. While the server does not answer, the
    loaded model stays in use, with a note about its age. When the server answers again, the catalog replaces the local
    copy. Use the model in a ``with`` block, which closes the opened catalogs.

    Attributes
    ----------
    version
        `Catalog.version` of the loaded views; empty before the first call.
    """

    catalog: Catalog
    descriptor: str | None = None
    version: str = field(default="", init=False)
    _loaded_state: object = field(default=None, init=False)
    _model: Model | None = field(default=None, init=False)
    _seen: str = field(default="", init=False)
    _server: Catalog | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self._attempts = Attempts(self.catalog.clock)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._server is not None:
            self._server.close()

    def __call__(self, progress: Callable[[JobProgress], None] | None = None) -> Model:
        """Return the model; errors as `load_model`, and `CatalogUnavailable` if none was loaded before.

        ``progress`` is called while views are described.
        """
        try:
            self._leave_copy()
            rules = self.catalog.path / FILE
            changed = self.catalog.database.may_have_changed()
            version = self.catalog.version() if changed or not self.version else self.version
            state = version, rules.stat().st_mtime_ns if rules.exists() else None
            if state != self._loaded_state:
                self._model = load_model(self.catalog, descriptor=self.descriptor, progress=progress)
                self._loaded_state, self.version = state, version
                if self.catalog.place.url is not None:
                    with suppress(RigError):  # the copy is for later; the search has its model already
                        update_copy(self.catalog)
        except CatalogUnavailable:
            if self._model is None:
                raise
            if not self._seen:  # the model of the copy has its note
                return self._model
            note = Note(NoteCode.LOCAL_COPY, {"copied_utc": self._seen})
            return replace(self._model, notes=(note, *self._model.notes))
        assert self._model is not None
        if self.catalog.copied_utc is None:
            self._seen = f"{self.catalog.clock.utc():%Y-%m-%d %H:%M:%S} UTC"
        return self._model

    def _leave_copy(self) -> None:
        """Replace a local copy by the catalog itself when its server answers again."""
        place = self.catalog.copy_of
        if place is None:
            return
        with suppress(RigError):
            self._server = self._attempts.open(place)
            self.catalog, self._loaded_state, self.version = self._server, None, ""
