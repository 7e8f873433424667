"""What a freshly enrolled object may be taken for."""

from hbr.model import symmetry
from hbr.model.views import Views
from rig.core.errors import ObjectNotFound
from rig.events.events import SimilarObject, SimilarObjects

TOLD = 3
"""Objects that are named as confusable."""


def similar_objects(views: Views, name: str) -> SimilarObjects:
    """Judge how alike an enrolled object is to itself from other sides, and to the other objects.

    Raises
    ------
    ObjectNotFound
        The object has no views there.
    """
    if name not in views.object_names:
        raise ObjectNotFound(
            f"{name!r} has no complete enrollment.", next_step="Enroll it, or finish its enrollment with --resume."
        )
    number = views.object_names.index(name)
    own = symmetry.symmetry(views, number)
    return SimilarObjects(
        name=name,
        period_deg=own.period_deg if own else None,
        neighbours=own.neighbours if own else None,
        alike=own.alike if own else None,
        lookalikes=tuple(
            SimilarObject(views.object_names[one.object_index], one.arcs_deg, one.share, one.similarity)
            for one in symmetry.similar_objects(views, number)[:TOLD]
        ),
    )
