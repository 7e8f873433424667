"""Symmetry of a new object, and the objects that it can be confused with."""

from hbr.model import symmetry
from hbr.model.views import Views
from rig.core.errors import ObjectNotFound
from rig.events.events import SimilarObject, SimilarObjects

REPORTED = 3
"""Largest number of similar objects in a report."""


def similar_objects(views: Views, name: str) -> SimilarObjects:
    """Compare the views of an enrolled object with each other and with those of the other objects.

    Raises
    ------
    ObjectNotFound
        The object has no views.
    """
    if name not in views.object_names:
        raise ObjectNotFound(
            f"{name!r} has no complete enrollment.", next_step="Enroll it, or complete its enrollment with --resume."
        )
    number = views.object_names.index(name)
    own = symmetry.symmetry(views, number)
    return SimilarObjects(
        name=name,
        period_deg=own.period_deg if own else None,
        neighbours=own.neighbours if own else None,
        alike=own.similarity if own else None,
        lookalikes=tuple(
            SimilarObject(views.object_names[one.object_index], one.arcs_deg, one.share, one.similarity)
            for one in symmetry.similar_objects(views, number)[:REPORTED]
        ),
    )
