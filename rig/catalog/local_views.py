"""The enrolled views of an object near some azimuths, cut out as at its enrollment (`hbr.dense.local_difference`)."""

from collections.abc import Sequence

from sqlalchemy import select

from hbr.dense.last_steps import near
from hbr.dense.local_difference import LocalView
from rig.catalog.catalog import Catalog
from rig.catalog.describing import stored_describer
from rig.catalog.schema import sessions
from rig.core.errors import CatalogDamaged
from rig.core.next_steps import Do
from rig.views.description import BENCH_DESCRIPTOR


def local_views(catalog: Catalog, name: str, azimuths_deg: Sequence[float]) -> list[LocalView]:
    """Return the enrolled views of an object that are nearest to each of these azimuths, by azimuth.

    Which these are, `hbr.dense.last_steps.near` decides for the bench and for the evaluation.

    Raises
    ------
    ObjectNotFound, CatalogError
        There is no such object, or an image is missing or is not the stored one.
    """
    views = catalog.object(name).views
    wanted = [views[place] for place in near([view.record.azimuth_deg for view in views], azimuths_deg)]
    with catalog.database.read() as connection:
        tables = {
            row.id: (row.empty_table_image, row.empty_table_image_sha256)
            for row in connection.execute(select(sessions).where(sessions.c.id.in_({v.session.id for v in wanted})))
            if row.empty_table_image is not None
        }
    found = []
    for view in wanted:
        describer = stored_describer(
            catalog.database.images, (BENCH_DESCRIPTOR,), view.record.region, tables.get(view.session.id)
        )
        try:
            cut = describer.segment(catalog.read_image(view), view.record.segmentation)
        except ValueError as error:
            raise CatalogDamaged(
                f"The view {view.id} of {name} cannot be segmented: {error}.", next_step=Do.VERIFY_CATALOG()
            ) from error
        found.append(LocalView(cut.crop, cut.mask, view.record.azimuth_deg))
    return found
