"""The model of a search: the enrolled views by one descriptor. A search begins with it.

`CurrentModel` is that of a catalog, loaded again when the catalog has changed.

Decision: docs/decisions/0017.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

import hbr
from hbr.dense.arc import ArcSession
from hbr.paper.hmm import PoseModel
from rig.bench import Bench
from rig.catalog import Catalog, derived
from rig.catalog.copying import Attempts, update_copy
from rig.catalog.jobs import JobProgress
from rig.config import RigConfig
from rig.core.errors import CatalogError, CatalogUnavailable, RigError, UsageError
from rig.core.next_steps import Do
from rig.events.events import Note, NoteCode
from rig.search.session import AnyStrategy, DenseSearch, EnrolledViews, HoughSearch, PoseSearch, Search
from rig.search.strategies import descriptor_for, strategy_for
from rig.search.strategies import strategy as strategy_named
from rig.views.description import BENCH_DESCRIPTOR, DENSE_DESCRIPTORS
from rig.views.empty_table import empty_table_status


@dataclass(frozen=True, eq=False)
class Model:
    """Enrolled views, prepared for searches: the paper's, or the dense ones."""

    index: hbr.ViewIndex | hbr.DenseIndex
    """Index for the paper's searches, or for the dense search."""
    notes: tuple[Note, ...] = ()
    """For the operator about an answer by this model."""
    with_empty_table: bool | None = None
    """Whether most objects were enrolled with an empty-table image; None if that is not known."""
    camera: tuple[Mapping[str, Any], ...] = field(default=(), repr=False)
    """The camera's settings of the enrollments, each combination once."""
    empty_table: NDArray[np.uint8] | None = field(default=None, repr=False)
    """The newest sheet of empty-table images of the enrollments, uint8 (H, W, 3) (`rig.views.table_sheet`)."""
    leader_views: EnrolledViews | None = field(default=None, repr=False)
    """Returns the enrolled views of an object near some azimuths (`rig.catalog.derived.local_views`); None if the model
    does not come from a catalog."""

    @property
    def views(self) -> hbr.Views:
        """The enrolled views."""
        return self.index.views

    @property
    def is_dense(self) -> bool:
        """Whether it is for the dense search."""
        return isinstance(self.index, hbr.DenseIndex)

    @property
    def descriptor(self) -> str:
        """The descriptor of the enrolled views, and of queries."""
        return self.views.descriptor


def model_of(views: hbr.Views) -> Model:
    """Return a model of views: for the dense search if their descriptor is of it, else for the paper's."""
    return Model(_index(views))


def _index(views: hbr.Views) -> hbr.ViewIndex | hbr.DenseIndex:
    if views.descriptor in DENSE_DESCRIPTORS and len(views):
        return hbr.DenseIndex(views)
    # without views, any search may say that the catalog is empty
    return hbr.ViewIndex(views if len(views) else hbr.Views.empty())


_tree = lru_cache(maxsize=4)(partial(hbr.ViewIndex, method="tree"))  # built once for each model
_poses = lru_cache(maxsize=4)(PoseModel)  # built once for each model


def begin_search(
    model: Model, config: RigConfig, strategy: AnyStrategy | str | None = None, *, seed: int = 0
) -> Search:
    """Begin a search by a strategy: its name or an object, by default the one that the model is for.

    ``seed`` is for strategies that draw random numbers.

    Raises `CatalogError`: nothing is enrolled. `UsageError`: there is no such strategy, or the model is not for it.
    """
    chosen = strategy_for(model.descriptor) if strategy is None else strategy
    if isinstance(chosen, str):
        chosen = strategy_named(chosen)
    if not len(model.views):
        raise CatalogError("The catalog is empty.", next_step=Do.ENROLL())
    wanted = descriptor_for(chosen)
    if wanted != model.descriptor and not (wanted == BENCH_DESCRIPTOR and model.is_dense):
        raise UsageError(
            f"The strategy {chosen.name!r} needs views by {wanted}; this model has views by {model.descriptor}.",
            next_step=f"Load it with rig.search.model.load_model(catalog, descriptor={wanted!r}), or use another "
            "strategy.",
        )
    common = model.views, config, chosen, seed
    if isinstance(model.index, hbr.ViewIndex):
        if getattr(chosen, "poses", False):
            return PoseSearch(*common, _poses(model.views))
        return HoughSearch(*common, _tree(model.views) if config.identify.index == "tree" else model.index)
    if getattr(chosen, "in_motion", False):
        return DenseSearch(*common, ArcSession(model.index))
    return DenseSearch(*common, hbr.DenseSession(model.index, max_views=config.identify.max_views))


def load_model(
    catalog: Catalog, *, descriptor: str | None = None, progress: Callable[[JobProgress], None] | None = None
) -> Model:
    """Load the enrolled views, by the bench's own descriptor.

    ``descriptor`` is another one, for a strategy of the paper. ``progress`` is called while the program describes views
    that have no description by it.

    Raises `UsageError`: there is no such descriptor. `CatalogError`, `CatalogBusy`: the catalog cannot be read, or a
    view cannot be described.
    """
    # The views, and how old they are if they come from a local copy.
    views = derived.views(catalog, descriptor or BENCH_DESCRIPTOR, progress)
    copied = catalog.copied_utc
    notes: tuple[Note, ...] = ()
    if copied is not None:
        notes = (Note(NoteCode.LOCAL_COPY, {"copied_utc": f"{copied:%Y-%m-%d %H:%M:%S} UTC"}),)
    camera = tuple(derived.camera_settings(catalog))
    model = Model(_index(views), notes, camera=camera)
    if not model.is_dense:
        return model
    # Views are compared only with views that were described in the same way, so the majority decides whether the
    # search uses an empty-table image.
    before = derived.empty_tables(catalog)
    with_image = len(before.with_image) >= len(before.without_image)
    others = before.without_image if with_image else before.with_image
    if others:
        notes += (Note(NoteCode.MIXED_EMPTY_TABLE, {"objects": list(others), "with_image": not with_image}),)
    table = None
    if with_image and before.newest is not None:
        with suppress(CatalogError):  # rig catalog verify reports it; the bench has its own image
            table = catalog.read_image(before.newest)
    return Model(model.index, notes, with_image, camera, table, partial(derived.local_views, catalog))


def empty_table_for(bench: Bench, model: Model) -> tuple[NDArray[np.uint8] | None, tuple[Note, ...]]:
    """Return the sheet of empty-table images that a search uses, and notes for the operator about it.

    It is the bench's own of today, else the one of the enrollment. It is None if the objects were enrolled without an
    image, because views are compared only with views that were described in the same way.
    """
    if not model.is_dense:
        return None, ()
    status = empty_table_status(bench)
    problems = {"problems": [problem.as_json() for problem in status.problems]}
    if model.with_empty_table is False:
        return None, () if status.table is None else (Note(NoteCode.ENROLLED_WITHOUT_EMPTY_TABLE),)
    if status.table is not None:
        return status.table.image_bgr, (Note(NoteCode.EMPTY_TABLE_DOUBTED, problems),) if status.problems else ()
    if model.empty_table is None:
        return None, (Note(NoteCode.EMPTY_TABLE_MISSING, problems),)
    return model.empty_table, (Note(NoteCode.EMPTY_TABLE_OF_ENROLLMENT, problems),)


@dataclass(eq=False)
class CurrentModel:
    """Loads the enrolled views, and again after a change of the catalog.

    If the catalog is on a server, it brings the local copy up to date, too. While the server does not answer, the
    loaded model stays in use, with a note about its age. When the server answers again, the catalog replaces the local
    copy. Use the model in a ``with`` block, which closes the opened catalogs.

    ``version`` is `Catalog.version` of the loaded views; empty before the first call.
    """

    catalog: Catalog
    descriptor: str | None = None
    version: str = field(default="", init=False)
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
            version = self.catalog.version()
            if version != self.version:
                self._model = load_model(self.catalog, descriptor=self.descriptor, progress=progress)
                self.version = version
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
            self.catalog, self.version = self._server, ""
