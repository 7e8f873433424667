"""The local copy of a catalog on a server, which searches read while the server does not answer.

It has the enrollments that searches use, with their descriptions, but no images of views.

Decision: docs/decisions/0011.
"""

import fcntl
import json
import os
import shutil
from collections import defaultdict
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

from sqlalchemy import select
from sqlalchemy.orm import Session as Transaction

from rig.catalog import derived
from rig.catalog.catalog import Catalog
from rig.catalog.database import properties
from rig.catalog.facts import Derived, Property
from rig.catalog.images import Images
from rig.catalog.jobs import finished
from rig.catalog.transfer import CatalogSource, Conflict, transfer
from rig.catalog.upkeep import collect_garbage
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import Clock
from rig.core.errors import CatalogBusy, CatalogError, CatalogUnavailable
from rig.core.files import json_values, no_follow

_COPY: Final = "copy"
"""Property of a local copy: of which catalog it is, and when it was made."""
_NEW: Final = ".copy-"
"""Begins the name of the folder in which a copy is made."""
_PATIENCE: Final = 20  # a server that is away costs one wait in twenty-one times that long


class Attempts:
    """Attempts to open catalogs, with pauses, so that the operator does not wait repeatedly for a server that is down.

    An attempt that failed after a time t is repeated after 20 t: a host that rejects a connection takes milliseconds,
    a network that drops packets takes seconds. Until then the same error is raised at once.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._not_before_ns = clock.now_ns()
        self._error: CatalogUnavailable | None = None

    def open(self, place: CatalogPlace, *, create: bool = False) -> Catalog:
        """Open a catalog, for reading only unless it is created if there is none; errors as `Catalog.open`."""
        begun_ns = self._clock.now_ns()
        if self._error is not None and begun_ns < self._not_before_ns:
            raise self._error.with_traceback(None)  # a traceback grows each time that an error is raised
        try:
            return Catalog.open(place, clock=self._clock, create=create, read_only=not create)
        except CatalogUnavailable as error:
            now_ns = self._clock.now_ns()
            self._error, self._not_before_ns = error, now_ns + _PATIENCE * (now_ns - begun_ns)
            raise


def open_copy(place: CatalogPlace, clock: Clock) -> Catalog:
    """Return the local copy, open for reading; `Catalog.copied_utc` says when it was made.

    Raises `CatalogUnavailable`: there is no copy of this catalog.
    """
    with suppress(CatalogError):
        copy = Catalog.open(place.copy_folder, clock=clock, create=False, read_only=True)
        with copy.database.read() as transaction:
            made = _about(transaction)
        if made.get("catalog") == str(place):
            copy.copied_utc, copy.copy_of = datetime.fromisoformat(made["copied_utc"]), place
            return copy
        copy.close()
    raise CatalogUnavailable(
        f"This computer has no copy of the catalog {place}.",
        next_step="Search once while the server answers: the search makes the copy.",
    )


def open_or_copy(
    place: CatalogPlace, clock: Clock, *, create: bool = False, attempts: Attempts | None = None
) -> Catalog:
    """Return a catalog, open for reading; its local copy while its server or its store does not answer.

    With ``create`` the catalog is created if there is none, and is open for writing. ``attempts`` are those of a
    program that opens the catalog often.

    Raises `CatalogUnavailable`: there is no copy either.
    """
    try:
        return (attempts or Attempts(clock)).open(place, create=create)
    except CatalogUnavailable as error:
        try:
            return open_copy(place, clock)
        except CatalogUnavailable as missing:
            raise CatalogUnavailable(
                f"{error.what} {missing.what}",
                next_step=(*error.steps, *missing.steps),
                evidence=error.evidence,
            ) from error


def _about(transaction: Transaction) -> dict[str, Any]:
    """Return what a local copy is of: place and id of the catalog, and the time."""
    stored = transaction.scalar(select(Property.value).where(Property.key == _COPY))
    with suppress(ValueError, TypeError):
        return dict(json_values((stored or "").encode()))
    return {}


def update_copy(catalog: Catalog) -> bool:
    """Bring the local copy up to date; return whether anything had changed.

    Only new, deleted and renamed objects and other texts are brought over. A copy that is damaged, of another catalog,
    or different in another way (an object was described again) is made again and takes the place of the former one.

    Raises `CatalogDamaged`: the catalog is not as it was stored; the copy stays as it is. `CatalogError`,
    `CatalogBusy`: one of them cannot be used, or another program makes the copy.
    """
    place, clock = catalog.place, catalog.clock
    theirs = _searched(catalog)
    with catalog.database.read() as transaction:
        about = {"catalog": str(place), "id": properties(transaction)["id"]}
    own = about | {"copied_utc": clock.utc().isoformat()}
    # Bring the present copy up to date.
    with suppress(CatalogError):
        open_copy(place, clock).close()
        with Catalog.open(place.copy_folder, clock=clock) as copy:
            with copy.database.read() as transaction:
                is_of_it = about.items() <= _about(transaction).items()
            ours = _searched(copy)
            if is_of_it and ours != theirs:
                names = {found.seal: name for name, found in ours.items()}
                for name, found in theirs.items():
                    before = names.get(found.seal)
                    if before is not None and (before, *ours[before][:2]) != (name, *found[:2]):
                        copy.rename(before, name)
                        copy.set_texts(name, label=found.label, note=found.note)
                now = _searched(copy)
                copy.delete(*(now.keys() - theirs.keys()))
                if changed := [name for name, found in theirs.items() if now.get(name) != found]:
                    _fill(copy, CatalogSource(catalog, changed))
                collect_garbage(copy, old=True)
            if is_of_it and list(_searched(copy).items()) == list(theirs.items()):  # in the same order
                _sign(copy, own)
                return ours != theirs
    # Make another one.
    with catalog.database.catalog_errors(), only_program(place.path / "copying", "makes the local copy"):
        for left in place.path.glob(f"{_NEW}*"):  # by a program that was killed
            shutil.rmtree(left, ignore_errors=True)
        with TemporaryDirectory(prefix=_NEW, dir=place.path) as folder:
            with Catalog.open(Path(folder, place.copy_folder.name), clock=clock) as made:
                _fill(made, CatalogSource(catalog))
                _sign(made, own)
            shutil.rmtree(place.copy_folder, ignore_errors=True)
            made.path.rename(place.copy_folder)
    return True


@contextmanager
def only_program(lock: Path, doing: str) -> Iterator[None]:
    """Prevent that another program does the same. Raises `CatalogBusy`: one does it, "makes the local copy"."""
    held = no_follow(str(lock), os.O_RDWR | os.O_CREAT, mode=0o600)
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)  # the system releases it when the process ends
    except BlockingIOError as error:
        raise CatalogBusy(f"Another program {doing} now.", next_step="Try again later.") from error
    else:
        yield
    finally:
        os.close(held)


class _Searched(NamedTuple):
    """What searches read of an object: its texts, its seal, and digests of what is computed from it."""

    label: str
    note: str
    seal: str
    computed: list[object] | None


def _searched(catalog: Catalog) -> dict[str, _Searched]:
    """Return what searches read of each object by its name."""
    with catalog.reading() as state:
        computed = defaultdict[str, list[object]](list)
        columns = select(Derived.seal, Derived.what, Derived.made_by, Derived.sha256)
        for seal, *row in state.transaction.execute(columns.order_by(Derived.seal, Derived.what)):
            computed[seal].append(row)
        texts = {line.object_id: (line.label or "", line.note or "") for line in state.in_use()}
        return {
            one.name: _Searched(*texts[one.object_id], one.seal, computed.get(one.seal))
            for one in state.used(checked=True)
        }


def _fill(copy: Catalog, source: CatalogSource) -> None:
    """Transfer objects into the local copy without their images, but with the newest one of the empty table."""
    store, copy.database.images = copy.database.images, _NoImages(copy.path)
    finished(transfer(source, copy, conflict=Conflict.REPLACE, once=True))
    copy.database.images, newest = store, derived.empty_tables(copy).newest
    with copy.database.catalog_errors():
        if newest is not None and not store.size(newest):
            with suppress(CatalogError):  # rig catalog verify reports it
                store.put(source.catalog.database.images.content(newest))
        store.remove(store.names() - {newest})


def _sign(copy: Catalog, about: dict[str, Any]) -> None:
    with copy.database.write() as transaction:
        transaction.merge(Property(key=_COPY, value=json.dumps(about)))


class _NoImages(Images):
    """The images of a local copy while it is made: none, because searches need what was computed from them."""

    are_kept = False

    def missing(self, names: Collection[str]) -> set[str]:  # noqa: ARG002
        return set()
