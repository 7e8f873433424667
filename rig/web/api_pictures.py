"""The REST API: pictures for people: an enrolled object at a pose, its silhouette, and where two objects differ."""

from typing import Annotated, Final

from fastapi import Query, Request, Response
from pydantic import BaseModel

from hbr.core.angles import wrap180
from hbr.model.symmetry import extreme_pairs
from rig.catalog.derived import views
from rig.catalog.describing import described, silhouette
from rig.core.errors import JobNotFound
from rig.views.description import BENCH_DESCRIPTOR, within
from rig.web.answers import Jpeg
from rig.web.api_catalog import Full, Number, sent_image
from rig.web.picture import outlines_of
from rig.web.server import Routes, Server

PICTURE_PX: Final = 720  # half of a tablet's screen; larger: a page with eight of them loads slowly
Object = Annotated[str, Query(alias="object", max_length=100, description="name of an enrolled object")]
Azimuth = Annotated[float, Query(allow_inf_nan=False, description="of the camera around the object, in degrees")]


class Pair(BaseModel):
    """A view of an object, the view of the other object that looks most like it, and their similarity from 0 to 1."""

    view: int
    azimuth_deg: float
    other_view: int
    other_azimuth_deg: float
    similarity: float


class Pairs(BaseModel):
    """The views at which two objects look most alike, and at which they differ most."""

    alike: Pair
    different: Pair


class Silhouette(BaseModel):
    """The outlines of the object in the picture of a view of this size, in pixels."""

    width: int
    height: int
    points: list[list[list[int]]]


def add_pictures(routes: Routes, server: Server) -> None:
    @routes.watch.get("/views/{view_id}/image", tags=["catalog"], response_class=Jpeg)
    def get_view_image(request: Request, view_id: Number, full: Full = False) -> Response:
        """Return the region of a view that is described, as JPEG for the eye, or its whole image."""
        with server.catalog.open_to_read() as catalog:
            view = catalog.view(view_id)
            return sent_image(request, catalog, view.image, full=full, px=PICTURE_PX, region=view.region)

    @routes.watch.get("/pose-picture", tags=["catalog"], response_class=Jpeg)
    def get_pose_picture(request: Request, object_name: Object, azimuth_deg: Azimuth = 0.0) -> Response:
        """Return the enrolled view of an object that is nearest to an azimuth, as JPEG for the eye."""
        with server.catalog.open_to_read() as catalog:
            found = catalog.object(object_name).views
            if not found:
                raise _not_enrolled(object_name)
            view = min(found, key=lambda view: abs(wrap180(view.azimuth_deg - azimuth_deg)))
            return sent_image(request, catalog, view.image, full=False, px=PICTURE_PX, region=view.region)

    @routes.watch.get("/silhouette", tags=["catalog"])
    def get_silhouette(object_name: Object, index: Annotated[int, Query(ge=0, lt=10_000)]) -> Silhouette:
        """Return the silhouette of an object in one of its views, as the description uses it; ``index`` from 0."""
        with server.catalog.open_to_read() as catalog, catalog.database.catalog_errors():
            enrollment = catalog.object(object_name).complete
            if enrollment is None or index >= len(enrollment.views):
                raise JobNotFound(f"{object_name!r} has no such view.", next_step="Choose one of GET /api/v1/objects.")
            view = enrollment.views[index]
            evidence = described(catalog.database, enrollment, object_name, BENCH_DESCRIPTOR).segmentation[index]
            whole, _ = silhouette(catalog.database.images, view, enrollment.sessions[view.session], evidence)
        mask = within(whole, view.region)
        height, width = mask.shape
        return Silhouette(width=width, height=height, points=outlines_of(mask))

    @routes.watch.get("/pairs", tags=["catalog"])
    def get_pairs(object_name: Object, other: Annotated[str, Query(max_length=100)]) -> Pairs:
        """Return where two objects look most alike, and where they differ most, by the similarity of their views."""
        with server.catalog.open_to_read() as catalog:
            one, two = (catalog.object(name) for name in (object_name, other))
            known = views(catalog, BENCH_DESCRIPTOR)
        for item in (one, two):
            if not item.views:
                raise _not_enrolled(item.summary.name)
        numbers = [known.object_names.index(item.summary.name) for item in (one, two)]

        def pair(own: int, others: int, similarity: float) -> Pair:
            first, second = one.views[own], two.views[others]
            return Pair(
                view=first.id,
                azimuth_deg=first.azimuth_deg,
                other_view=second.id,
                other_azimuth_deg=second.azimuth_deg,
                similarity=similarity,
            )

        alike, different = (pair(*found) for found in extreme_pairs(known, *numbers))
        return Pairs(alike=alike, different=different)


def _not_enrolled(name: str) -> JobNotFound:
    return JobNotFound(f"{name!r} has no complete enrollment.", next_step="Choose one of GET /api/v1/objects.")
