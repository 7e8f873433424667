"""The model of a catalog, loaded again when the catalog has changed."""

from rig.catalog import Catalog
from rig.search.model import Model, load_model
from rig.search.stopping_rules import FILE


class CurrentModel:
    """Loads the enrolled views, and again after a change of the catalog or of its stopping rule.

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
        self.version = ""

    def __call__(self) -> Model:
        """Return the model; errors as `load_model`."""
        rules = self._catalog.path / FILE
        version = self._catalog.version()
        state = version, rules.stat().st_mtime_ns if rules.exists() else None
        if state != self._loaded_state:
            self._model, self._loaded_state = load_model(self._catalog, descriptor=self._descriptor), state
            self.version = version
        return self._model
