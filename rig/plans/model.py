"""What a search compares views with: the enrolled views by one descriptor, and the rules of the dense search."""

from dataclasses import dataclass

import hbr
from rig.catalog import Catalog
from rig.describer import BENCH_DESCRIPTOR, PAPER_DESCRIPTOR
from rig.errors import DescriptorOutdated
from rig.plans.rules import rules_of


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
    """

    index: hbr.ViewIndex | hbr.DenseIndex
    rules: hbr.Rules | None = None
    notes: tuple[str, ...] = ()

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
    else they are rehearsed, on a sample that does not keep anybody waiting (`rig.plans.rules.rules_of`).

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
        if catalog.describes(BENCH_DESCRIPTOR):
            try:
                return _dense(catalog)
            except DescriptorOutdated as error:
                notes = (_fallback(f"{error.what}"),)
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
    return Model(index, rules, notes)


def _fallback(reason: str) -> str:
    return (
        f"the search goes by {PAPER_DESCRIPTOR}, of the whole picture: {reason}; "
        f"rig catalog redescribe --descriptor {BENCH_DESCRIPTOR} adds it from the stored images"
    )
