"""What a search compares views with: the enrolled views by one descriptor, and the rules of the dense search."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

import hbr
from rig.bench import Bench
from rig.catalog import Catalog
from rig.catalog.descriptions import empty_tables, has_descriptor, read_empty_table
from rig.core.errors import CatalogError, DescriptorOutdated
from rig.search.stopping_rules import rules_of
from rig.views.description import BENCH_DESCRIPTOR, PAPER_DESCRIPTOR
from rig.views.empty_table import COMMAND, empty_table_status


@dataclass(frozen=True, eq=False)
class Model:
    """Enrolled views, made ready for searches.

    Attributes
    ----------
    index : hbr.ViewIndex or hbr.DenseIndex
        For the paper's searches, or for the dense one.
    rules : hbr.Rules, optional
        When the dense search ends, and what it calls unknown.
    notes
        What a person should know of an answer by this model.
    pictured
        Whether the objects were enrolled with a picture of the empty table, most of them; None where nobody knows.
    empty_table : uint8 array (H, W, 3), optional
        The newest picture that they were enrolled with.
    """

    index: hbr.ViewIndex | hbr.DenseIndex
    rules: hbr.Rules | None = None
    notes: tuple[str, ...] = ()
    pictured: bool | None = None
    empty_table: NDArray[np.uint8] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if isinstance(self.index, hbr.DenseIndex) and self.rules is None:
            raise ValueError("a dense search needs rules; take load_model, or hbr.rules(hbr.rehearse(index, ...))")

    @property
    def views(self) -> hbr.Views:
        """The enrolled views."""
        return self.index.views

    @property
    def descriptor(self) -> str:
        """What they are described by, and queries must be."""
        return self.views.descriptor


def model_of(views: hbr.Views, *, rules: hbr.Rules | None = None, notes: tuple[str, ...] = ()) -> Model:
    """Make a model of views: for the dense search where there are rules, else for the paper's."""
    return Model(hbr.ViewIndex(views)) if rules is None else Model(hbr.DenseIndex(views), rules, notes)


def load_model(catalog: Catalog, *, descriptor: str | None = None) -> Model:
    """Load what is enrolled: by the bench's own descriptor where every object has it, else by the paper's.

    The rules of the dense search are those that `rig catalog calibrate` has stored, where they are of this catalog;
    else they are rehearsed, on a sample that does not keep anybody waiting (`rig.search.stopping_rules.rules_of`).

    Parameters
    ----------
    catalog
        An open one.
    descriptor
        To have this and no other.

    Raises
    ------
    DescriptorOutdated
        Objects lack the descriptor that was asked for, or both.
    CatalogError, CatalogBusy
        The catalog cannot be read.
    """
    notes: tuple[str, ...] = ()
    if descriptor is None:
        if has_descriptor(catalog, BENCH_DESCRIPTOR):
            try:
                return _dense(catalog)
            except DescriptorOutdated as error:
                notes = (_fallback(error.what),)
        else:
            notes = (_fallback(f"the catalog has no {BENCH_DESCRIPTOR}"),)
    elif descriptor == BENCH_DESCRIPTOR:
        return _dense(catalog)
    views = catalog.views(PAPER_DESCRIPTOR).views
    return Model(hbr.ViewIndex(views), notes=notes if len(views) else ())


def _dense(catalog: Catalog) -> Model:
    views = catalog.views(BENCH_DESCRIPTOR).views
    if not len(views):
        return Model(hbr.ViewIndex(hbr.Views.empty()))  # the search says so
    index = hbr.DenseIndex(views)
    rules, notes = rules_of(catalog.path, index)
    before = empty_tables(catalog)
    pictured = len(before.with_image) >= len(before.without_image)
    others = before.without_image if pictured else before.with_image
    if others:
        notes += (
            f"{_few(others)} {'was' if len(others) == 1 else 'were'} enrolled {'without' if pictured else 'with'} a "
            "picture of the empty table, unlike the others: such views compare badly; rig enroll --replace takes them "
            "anew",
        )
    table = None
    if pictured and before.newest is not None:
        with suppress(CatalogError):  # rig catalog verify tells of it; the bench has a picture of its own
            table = read_empty_table(catalog, before.newest)
    return Model(index, rules, notes, pictured, table)


def empty_table_for(bench: Bench, model: Model) -> tuple[NDArray[np.uint8] | None, tuple[str, ...]]:
    """Return the picture of the empty table that a search goes by, and what a person should know of that.

    The bench's own of today; where it has none, the one that the objects were enrolled with. None where they were
    enrolled without: views are compared with views that were described alike.
    """
    if not isinstance(model.index, hbr.DenseIndex):
        return None, ()
    status = empty_table_status(bench)
    if model.pictured is False:
        if status.table is None:
            return None, ()
        return None, (
            "most objects were enrolled without a picture of the empty table, and are searched without; "
            "rig enroll --replace takes them anew with it",
        )
    if status.table is not None:
        return status.table.image_bgr, (f"{status.text}; {COMMAND} takes a new one",) if status.problems else ()
    if model.empty_table is None:
        return None, (f"{status.text}; {COMMAND} takes one",)
    return model.empty_table, (f"{status.text}: the image of the enrollment is used; {COMMAND} takes a new one",)


def _few(names: Sequence[str]) -> str:
    shown = ", ".join(names[:3])
    return shown if len(names) <= 3 else f"{shown} and {len(names) - 3} more"


def _fallback(reason: str) -> str:
    return (
        f"the search goes by {PAPER_DESCRIPTOR}, of the whole picture: {reason}; "
        f"rig catalog redescribe --descriptor {BENCH_DESCRIPTOR} adds it from the stored images"
    )
