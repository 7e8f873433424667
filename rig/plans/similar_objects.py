"""The objects that an enrolled object can be confused with."""

from dataclasses import asdict

from hbr.model import symmetry
from hbr.model.views import Views
from rig.core.errors import ObjectNotFound
from rig.core.next_steps import Do
from rig.events.events import SimilarObject, SimilarObjects

SHOWN = 3
"""The number of similar objects that are named."""


def similar_objects(views: Views, name: str) -> SimilarObjects:
    """Measure how similar an enrolled object is to itself from other sides, and to the other objects.

    Raises `ObjectNotFound`: the object has no views.
    """
    if name not in views.object_names:
        raise ObjectNotFound(
            f"{name!r} has no complete enrollment.",
            next_step=(Do.ENROLL(name=name), "Or", Do.CONTINUE_ENROLLMENT(name=name)),
        )
    number = views.object_names.index(name)
    own = symmetry.symmetry(views, number)
    return SimilarObjects(
        name=name,
        period_deg=own.period_deg if own else None,
        neighbour_similarity=own.neighbours if own else None,
        period_similarity=own.similarity if own else None,
        objects=tuple(
            SimilarObject(
                name=views.object_names[one.object_index],
                **{key: value for key, value in asdict(one).items() if key != "object_index"},
            )
            for one in symmetry.similar_objects(views, number, SHOWN)
        ),
    )
