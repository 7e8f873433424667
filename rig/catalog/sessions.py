"""What the sessions of the enrolled objects have in common: the empty-table images and the camera's settings."""

from collections.abc import Iterable
from typing import Any, NamedTuple

from sqlalchemy import select

from rig.catalog import state
from rig.catalog.catalog import Catalog
from rig.catalog.columns import damaged
from rig.catalog.facts import Session, View
from rig.catalog.records import JsonObject


class EmptyTables(NamedTuple):
    """Names of the objects that were enrolled with an empty-table image and without, and the newest of these images."""

    with_image: tuple[str, ...]
    without_image: tuple[str, ...]
    newest: str | None


def empty_tables(catalog: Catalog) -> EmptyTables:
    """Return which of the objects in use were enrolled with an empty-table image."""
    newest: tuple[int, int] | None = None
    with_image: dict[str, bool] = {}
    with catalog.database.read() as transaction:
        owner = {one.enrollment_id: one.name for one in state.State(transaction).used()}
        rows = transaction.execute(
            select(Session.enrollment_id, Session.number, Session.empty_table).order_by(Session.started_utc)
        )
        for enrollment_id, number, image in rows:
            if (name := owner.get(enrollment_id)) is not None:
                with_image[name] = with_image.get(name, False) or image is not None
                newest = newest if image is None else (enrollment_id, number)
        image = None if newest is None else state.session(transaction, *newest).empty_table
    with_one = tuple(name for name in owner.values() if with_image.get(name))
    return EmptyTables(with_one, tuple(name for name in owner.values() if not with_image.get(name)), image)


def camera_settings(catalog: Catalog) -> list[dict[str, Any]]:
    """Return the camera's settings (`rig.devices.camera.CameraLocks`) of the objects in use, each combination once."""
    with catalog.database.read() as transaction:
        shown = _settings(
            (view.id, view.evidence) for view in state.State(transaction).first_views(View.id, View.evidence)
        )
        for view_id, _ in shown:
            state.view(transaction, view_id)  # of an edited one nothing is used
    return [settings for _, settings in shown]


def camera_settings_of(views: Iterable[View]) -> list[dict[str, Any]]:
    """Return the camera's settings of some views, each combination once."""
    return [settings for _, settings in _settings((view.id, view.evidence) for view in views)]


def _settings(evidence: Iterable[tuple[int, JsonObject | None]]) -> list[tuple[int, dict[str, Any]]]:
    """Return each combination of the camera's settings once, with the first view that has it."""
    found: list[tuple[int, dict[str, Any]]] = []
    for view_id, one in evidence:
        if one is None:
            raise damaged("the evidence of a view", None)
        locks = one.get("locks")
        if isinstance(locks, dict) and all(locks != known for _, known in found):
            found.append((view_id, locks))
    return found
