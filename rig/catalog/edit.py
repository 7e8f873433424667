"""Rename, label, delete and restore objects."""

from sqlalchemy import Connection, update

from rig.catalog import audit
from rig.catalog.catalog import Catalog
from rig.catalog.queries import check_free, find, object_summaries
from rig.catalog.records import ObjectSummary, checked_texts, clean_name
from rig.catalog.schema import objects
from rig.catalog.seal import changing_object


def rename(catalog: Catalog, name: str, new_name: str) -> None:
    """Give an object another name. Its images keep their files.

    Raises
    ------
    UsageError
        The new name is not valid.
    ObjectNotFound
        There is no object of that name.
    ObjectExists
        Another object has the new name.
    """
    new_name = clean_name(new_name)
    with catalog.database.write() as connection:
        object_id, name = find(connection, name)
        if new_name == name:
            return
        check_free(connection, new_name)
        with changing_object(connection, object_id):
            connection.execute(update(objects).where(objects.c.id == object_id).values(name=new_name))
        audit.append(connection, catalog.clock, audit.Action.RENAMED, new_name, before=name)


def set_texts(catalog: Catalog, name: str, *, label: str | None = None, note: str | None = None) -> None:
    """Change the label and the note of an object. None leaves them unchanged.

    Raises
    ------
    UsageError
        They are not valid text.
    ObjectNotFound
        There is no object of that name.
    """
    texts = checked_texts(label, note)
    with catalog.database.write() as connection:
        object_id, name = find(connection, name)
        if texts:
            with changing_object(connection, object_id):
                connection.execute(update(objects).where(objects.c.id == object_id).values(texts))
            audit.append(connection, catalog.clock, audit.Action.LABELLED, name, **texts)


def delete(catalog: Catalog, *names: str) -> None:
    """Delete objects, all or none. `undelete` restores them until `collect_garbage` removes them.

    Raises
    ------
    ObjectNotFound
        There is no object of one of these names.
    """
    with catalog.database.write() as connection:
        delete_in(connection, catalog, *names)


def delete_in(connection: Connection, catalog: Catalog, *names: str) -> None:
    """Delete objects in a transaction that is open. Errors as for `delete`."""
    now = catalog.clock.utc()
    for object_id, name in [find(connection, name) for name in dict.fromkeys(names)]:
        with changing_object(connection, object_id):
            connection.execute(update(objects).where(objects.c.id == object_id).values(deleted_utc=now))
        audit.append(connection, catalog.clock, audit.Action.DELETED, name)


def undelete(catalog: Catalog, name: str) -> None:
    """Restore the object that was deleted last under this name.

    Raises
    ------
    ObjectNotFound
        There is no deleted object of that name.
    ObjectExists
        An object in use has this name.
    """
    with catalog.database.write() as connection:
        object_id, name = find(connection, name, deleted=True)
        check_free(connection, name)
        with changing_object(connection, object_id):
            connection.execute(update(objects).where(objects.c.id == object_id).values(deleted_utc=None))
        audit.append(connection, catalog.clock, audit.Action.UNDELETED, name)


def deleted_objects(catalog: Catalog) -> list[ObjectSummary]:
    """Return the deleted objects that can be restored."""
    with catalog.database.read() as connection:
        return object_summaries(connection, objects.c.deleted_utc.is_not(None))
