"""A PostgreSQL server of the tests' own, in a temporary folder, and catalogs in it."""

import hashlib
import os
import pwd
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from rig.config.catalog_place import CatalogPlace

VARIABLE = "RIG_TEST_POSTGRES"
"""URL of a database: catalogs in folders are opened there instead, each in a schema of its own."""

_PLACES = [*sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True), Path("/usr/local/bin"), Path("/usr/bin")]
_OPTIONS = ["fsync=off", "full_page_writes=on", "max_connections=200", "listen_addresses="]


@cache
def programs() -> Path | None:
    """Return the folder of ``initdb`` and ``postgres``, None if they are not installed."""
    return next((place for place in _PLACES if (place / "initdb").exists() and (place / "postgres").exists()), None)


def missing() -> str | None:
    """Return why no server can be started here."""
    if find_spec("psycopg") is None:
        return "psycopg is not installed (make test-servers)"
    if programs() is None:
        return "PostgreSQL is not installed (apt-get install postgresql)"
    if os.geteuid() == 0 and _account() is None:
        return "PostgreSQL does not run as root, and there is no account 'postgres'"
    return None


def _account() -> pwd.struct_passwd | None:
    with suppress(KeyError):
        return pwd.getpwnam("postgres")  # Debian's package makes it
    return None


class PostgresServer:
    """A server with an empty database; it can be killed and started again."""

    def __init__(self) -> None:
        place = programs()
        assert place is not None
        self._bin = place
        self.folder = Path(tempfile.mkdtemp(prefix="rig-pg-", dir="/tmp"))
        self._process: subprocess.Popen[bytes] | None = None
        self._as: dict[str, Any] = {}
        if os.geteuid() == 0:
            account = _account()
            assert account is not None
            os.chown(self.folder, account.pw_uid, account.pw_gid)
            self._as = {"user": account.pw_uid, "group": account.pw_gid, "extra_groups": []}
        self.data = self.folder / "data"
        arguments = ["-D", self.data, "-A", "trust", "-U", "rig", "-E", "UTF8", "--no-locale", "--no-sync"]
        done = subprocess.run([self._bin / "initdb", *arguments], capture_output=True, cwd="/", **self._as, check=False)
        assert done.returncode == 0, done.stderr.decode()
        self.start()

    @property
    def url(self) -> str:
        return f"postgresql+psycopg://rig@/postgres?host={self.folder}"

    @property
    def runs(self) -> bool:
        return self._process is not None

    def start(self) -> None:
        """Start the server, and return when it answers."""
        with (self.folder / "log").open("ab") as log:
            options = [word for option in _OPTIONS for word in ("-c", option)]
            command = [self._bin / "postgres", "-D", self.data, "-k", self.folder, *options]
            self._process = subprocess.Popen(
                command, stdout=log, stderr=log, cwd="/", start_new_session=True, **self._as
            )
        ready = [self._bin / "pg_isready", "-q", "-h", self.folder, "-U", "rig"]
        for _ in range(300):
            if subprocess.run(ready, check=False).returncode == 0:
                return
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(0.1)
                break
        raise AssertionError((self.folder / "log").read_text())

    def stop(self, how: signal.Signals = signal.SIGINT) -> None:
        """Stop the server: SIGINT ends all connections, SIGQUIT and SIGKILL do not store anything before."""
        if self._process is None:
            return
        if how is signal.SIGKILL:
            os.killpg(self._process.pid, how)
        else:
            self._process.send_signal(how)
        self._process.wait(30)
        self._process = None

    def close(self) -> None:
        self.stop(signal.SIGQUIT)
        shutil.rmtree(self.folder, ignore_errors=True)


@contextmanager
def server() -> Iterator[PostgresServer]:
    """Yield a server; skip the test where there can be none."""
    if (reason := missing()) is not None:
        pytest.skip(reason)
    running = PostgresServer()
    try:
        yield running
    finally:
        running.close()


def place_in(url: str, folder: Path, images: str | None = None) -> CatalogPlace:
    """Return the place of a catalog in a schema of the database; the schema depends on the folder."""
    schema = f"catalog_{hashlib.sha256(str(folder).encode()).hexdigest()[:16]}"
    made = f"{url}&options=-csearch_path%3D{schema}"
    _make_schema(url, schema)
    return CatalogPlace(folder, made, images)


@cache
def _make_schema(url: str, schema: str) -> None:
    import psycopg

    with (
        psycopg.connect(url.replace("postgresql+psycopg", "postgresql"), autocommit=True) as connection,
        suppress(psycopg.errors.UniqueViolation),  # another process creates it in this moment
    ):
        connection.execute(f"CREATE SCHEMA IF NOT EXISTS {schema}")


def use_postgres() -> None:
    """Open the catalogs of this process in the database that the environment names, if it names one."""
    url = os.environ.get(VARIABLE)
    if url is None:
        return
    original = CatalogPlace.of.__func__  # type: ignore[attr-defined]

    def of(cls: type[CatalogPlace], place: Any) -> CatalogPlace:
        found: CatalogPlace = original(cls, place)
        is_export = any(part.startswith((".", "rig-export-")) for part in found.path.parts[-2:])
        if found.url is not None or is_export or found.database_file.exists():
            return found  # an export is a folder
        return place_in(url, found.path)

    copy_folder = shutil.copytree

    def copytree(source: Any, target: Any, *others: Any, **options: Any) -> Any:  # shutil calls it for each folder
        copied = copy_folder(source, target, *others, **options)
        if not isinstance(source, os.DirEntry) and Path(source, "catalog-id").exists():
            _copy_schema(url, Path(source), Path(target))
        return copied

    CatalogPlace.of = classmethod(of)  # type: ignore[method-assign,assignment]
    shutil.copytree = copytree


def _copy_schema(url: str, source: Path, target: Path) -> None:
    """Give the copy of a folder a copy of its catalog."""
    from sqlalchemy import text

    from rig.catalog.database import properties
    from rig.catalog.facts import Property, Row
    from rig.catalog.postgres import PostgresDatabase

    before = place_in(url, source.absolute())
    place = place_in(url, target.absolute())
    schema = str(before.url).rpartition("%3D")[2]
    (target / "catalog-id").unlink(missing_ok=True)
    made = PostgresDatabase(place, create=True, read_only=False, busy_timeout_s=5.0)
    with closing(made), made._writes.begin() as connection:
        if connection.execute(text(f"SELECT to_regclass('{schema}.{Property.__tablename__}')")).scalar() is None:
            return
        connection.execute(text(f"DELETE FROM {Property.__tablename__}"))
        for table in Row.metadata.sorted_tables:
            columns = ", ".join(f'"{column.name}"' for column in table.columns)
            connection.execute(text(f"INSERT INTO {table} ({columns}) SELECT {columns} FROM {schema}.{table}"))
        for name in ("enrollments", "views"):
            connection.execute(
                text(f"SELECT setval('{name}_id_seq', last_value, is_called) FROM {schema}.{name}_id_seq")
            )
        mark = properties(connection)["id"]
    (target / "catalog-id").write_text(str(mark))
