"""Errors of SQLite, of a database server and of the file system as errors of the catalog."""

import errno
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from sqlalchemy.engine import make_url
from sqlalchemy.exc import DBAPIError
from sqlalchemy.exc import TimeoutError as PoolTimeout

from rig.config.catalog_place import CatalogPlace
from rig.core.errors import CatalogBusy, CatalogDamaged, CatalogError, CatalogUnavailable, RigError
from rig.core.next_steps import Do


@contextmanager
def catalog_errors(place: CatalogPlace, busy_timeout_s: float) -> Iterator[None]:
    """Raise errors of the database, of the store of images, and of the file system as errors of the catalog."""
    try:
        yield
    except (DBAPIError, sqlite3.Error) as error:
        of_engine = _of_sqlite if place.url is None else _of_server
        known = of_engine(error.orig if isinstance(error, DBAPIError) else error, place, busy_timeout_s)
        if known is None:
            raise
        raise known from error
    except PoolTimeout as error:
        raise _unavailable(place, error) from error
    except (UnicodeDecodeError, OverflowError) as error:  # text that is none, or a number that no program stored
        raise _damaged(place, {"sqlite": str(error)}) from error
    except OSError as error:
        raise _of_system(error, place.images or place.path) from error


def _busy(place: CatalogPlace, busy_timeout_s: float, evidence: dict[str, str]) -> CatalogBusy:
    return CatalogBusy(
        f"Another process has been using the catalog {place} for {busy_timeout_s:g} s. Nothing was changed.",
        next_step="Wait until it has finished, and try again.",
        evidence=evidence,
    )


_GONE: Final = ("08", "57P", "25P03")
"""Beginnings of SQLSTATE: errors of a connection, a server that stops or starts, and a transaction that was idle."""


def _of_server(error: BaseException | None, place: CatalogPlace, busy_timeout_s: float) -> RigError | None:
    state = getattr(error, "sqlstate", None) or ""
    evidence = {"sqlstate": state, "server": str(error)}
    if state == "55P03":
        return _busy(place, busy_timeout_s, evidence)
    if state.startswith("53"):
        return CatalogError(
            f"The server of the catalog {place} has no space or memory left. This change was not stored. All earlier "
            "ones are safe.",
            next_step="Ask the administrator of the server, then continue.",
            evidence=evidence,
        )
    if state.startswith("28") or state in ("42501", "3D000", "25006"):
        return CatalogError(
            f"The server denies access to the catalog {place}: {error}.",
            next_step="Check catalog.url, ~/.pgpass and the rights of the user on the server.",
            evidence=evidence,
        )
    kinds = {kind.__name__ for kind in type(error).__mro__}
    # An error of the connection itself has no code.
    if state.startswith(_GONE) or (not state and kinds & {"OperationalError", "InterfaceError"}):
        return _unavailable(place, error)
    return None


def _accepts_connections(place: CatalogPlace) -> bool:
    """Return whether the server answers. The error of a connection that was denied has no code."""
    from psycopg.pq import PGconn, Ping

    url = make_url(str(place.url)).set(drivername="postgresql").update_query_dict({"connect_timeout": "2"})
    return bool(PGconn.ping(url.render_as_string(hide_password=False).encode()) == Ping.OK)


def _unavailable(place: CatalogPlace, error: object) -> CatalogUnavailable:
    if _accepts_connections(place):
        return CatalogUnavailable(
            f"The server of the catalog {place} denies the connection.",
            next_step="Check catalog.url, the password in ~/.pgpass, and the rights of the user on the server.",
            evidence={"server": str(error).strip()},
        )
    return CatalogUnavailable(
        f"The server of the catalog {place} does not answer.",
        next_step="Check the network and the server, then try again.",
        evidence={"server": str(error).strip()},
    )


def absent(root: Path) -> CatalogError:
    """Return the error for a folder without a catalog."""
    if root.exists() and not root.is_dir():
        return CatalogError(
            f"{root} is a file, not the folder of a catalog.", next_step="Give the folder of the catalog."
        )
    return CatalogError(
        f"There is no catalog in {root}.", next_step=("Check the path, or", Do.ENROLL(), "This creates it.")
    )


def _of_sqlite(error: BaseException | None, place: CatalogPlace, busy_timeout_s: float) -> RigError | None:
    evidence, root = {"sqlite": str(error)}, place.path
    match getattr(error, "sqlite_errorcode", 0) & 0xFF:
        case sqlite3.SQLITE_BUSY | sqlite3.SQLITE_LOCKED | sqlite3.SQLITE_PROTOCOL:
            return _busy(place, busy_timeout_s, evidence)
        case sqlite3.SQLITE_NOTADB:
            return CatalogError(
                f"{place.database_file} is not a catalog.",
                next_step="Give the folder of a catalog.",
                evidence=evidence,
            )
        case sqlite3.SQLITE_CORRUPT:
            return _damaged(place, evidence)
        case sqlite3.SQLITE_FULL:
            return _of_system(OSError(errno.ENOSPC, str(error)), root)
        case sqlite3.SQLITE_CANTOPEN | sqlite3.SQLITE_READONLY | sqlite3.SQLITE_PERM:
            return _of_system(OSError(errno.EACCES, str(error)), root)
        case sqlite3.SQLITE_IOERR:
            return _of_system(OSError(errno.EIO, str(error)), root)
    if isinstance(error, sqlite3.DatabaseError) and not isinstance(error, sqlite3.ProgrammingError):
        return _damaged(place, evidence)
    return None


def _damaged(place: CatalogPlace, evidence: dict[str, str]) -> CatalogDamaged:
    return CatalogDamaged(
        f"The catalog {place.database_file} is damaged.",
        next_step="Copy the folder, then restore the database from a backup.",
        evidence=evidence,
    )


def _of_system(error: OSError, root: object) -> CatalogError:
    evidence = {"errno": errno.errorcode.get(error.errno or 0, "unknown"), "system": str(error)}
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return CatalogError(
            f"The disk of the catalog {root} is full. This change was not stored. All earlier ones are safe.",
            next_step=(Do.FREE_DISK(), "Then continue."),
            evidence=evidence,
        )
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return CatalogError(
            f"No permission to use the catalog {root}.",
            next_step="Make the folder and its files writable for this user, or give another folder.",
            evidence=evidence,
        )
    return CatalogError(
        f"The catalog {root} cannot be used: {error}.",
        next_step="Check the folder and its disk; use a local disk for a catalog.",
        evidence=evidence,
    )
