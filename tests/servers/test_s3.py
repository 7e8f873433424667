"""Images in S3, against a real server process (moto), and copies of catalogs between engines and stores."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from http.client import HTTPException
from importlib.util import find_spec
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest
from sqlalchemy import text

from rig.catalog import Catalog, derived
from rig.catalog.images import FsspecImages
from rig.catalog.jobs import finished
from rig.catalog.results import record as record_result
from rig.catalog.transfer import CatalogSource, transfer
from rig.catalog.upkeep import collect_garbage
from rig.catalog.verify import CatalogProblem, verify
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import SystemClock
from rig.core.errors import CatalogError, CatalogUnavailable
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import fill, image, new_result
from tests.servers.postgres import PostgresServer, place_in


class S3Server:
    """A server of S3 with one bucket."""

    def __init__(self) -> None:
        self.process: subprocess.Popen[bytes] | None = None
        for _ in range(5):  # another program can take the free port before the server does
            with socket.socket() as free:
                free.bind(("127.0.0.1", 0))
                self.port = free.getsockname()[1]
            if self._is_started():
                return
        raise AssertionError("the S3 server did not start")

    def start(self) -> None:
        assert self._is_started(), "the S3 server did not start"

    def _is_started(self) -> bool:
        """Start the server; return whether it answers, and not another program at its port."""
        command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(self.port)]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for _ in range(600):
            with (
                suppress(OSError, HTTPException),
                urlopen(f"http://127.0.0.1:{self.port}/moto-api/data.json", timeout=10) as answer,
            ):
                return bool(answer.status == 200)
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(0.1)
                break  # it has ended
        self.stop()
        return False

    def stop(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process = None


@pytest.fixture(scope="module")
def s3() -> Iterator[S3Server]:
    if any(find_spec(name) is None for name in ("moto", "flask", "s3fs")):
        pytest.skip("moto's server and s3fs are not installed (make test-servers)")
    running = S3Server()
    values = {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{running.port}",
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in values.items():
            patch.setenv(name, value)
        import s3fs

        try:
            s3fs.S3FileSystem().mkdir("rig")
            yield running
        finally:
            running.stop()


def in_s3(postgres: PostgresServer, folder: Path) -> CatalogPlace:
    return place_in(postgres.url, folder, f"s3://rig/{folder.parent.name}/{folder.name}")


def opened(place: CatalogPlace | Path, **options: bool) -> Catalog:
    return Catalog.open(place, clock=VirtualClock(), **options)


def test_catalog_with_images_in_s3_does_everything(postgres: PostgresServer, s3: S3Server, tmp_path: Path) -> None:
    place = in_s3(postgres, tmp_path / "shared")
    with opened(place) as catalog:
        fill(catalog, "mug", 2, 0)
        fill(catalog, "tin", 2, 10)
        record_result(catalog, new_result(), image(1))
        (first, second) = catalog.object("mug").views
        assert np.array_equal(catalog.read_image(second.image), image(1))
        assert catalog.image_path(first.image).is_relative_to(tmp_path)
        assert finished(verify(catalog)).findings == ()
        store = catalog.database.images
        content = store.content(first.image)
        store.remove([first.image])
        with pytest.raises(CatalogError, match="missing"):
            catalog.read_image(first.image)
        assert [one.problem for one in finished(verify(catalog)).findings] == [CatalogProblem.MISSING_IMAGE]
        assert store.put(content) == first.image
        assert finished(verify(catalog)).findings == ()
        catalog.delete("tin")
        removed = collect_garbage(catalog)
        assert (removed.objects, removed.views, removed.files) == (("tin",), 2, 2)
        assert finished(verify(catalog)).findings == ()
    with pytest.raises(CatalogError, match=r"images of the catalog .* are not in"):
        opened(CatalogPlace(tmp_path / "other", place.url, "s3://rig/elsewhere"))
    with pytest.raises(CatalogError, match="does not exist") as error:
        opened(place_in(postgres.url, tmp_path / "new", "s3://no-such-bucket/new"))
    assert "Create its bucket" in error.value.next_step


def test_garbage_is_collected_in_a_slow_store(
    postgres: PostgresServer, s3: S3Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rig.catalog.postgres.LOST_BENCH_S", 1)
    listed = FsspecImages.names

    def slowly(store: FsspecImages, **options: float) -> set[str]:
        SystemClock().sleep(1.5)  # longer than the server lets others wait
        return listed(store, **options)

    monkeypatch.setattr(FsspecImages, "names", slowly)
    with opened(in_s3(postgres, tmp_path / "shared")) as catalog:
        fill(catalog, "mug", 2, 0)
        catalog.delete("mug")
        assert collect_garbage(catalog).files == 2
        assert collect_garbage(catalog).files == 0


def test_objects_are_imported_into_s3(postgres: PostgresServer, s3: S3Server, tmp_path: Path) -> None:
    with opened(tmp_path / "local") as local, opened(in_s3(postgres, tmp_path / "shared")) as catalog:
        fill(local, "mug", 2, 0)
        finished(transfer(CatalogSource(local), catalog))
        assert derived.views(catalog).object_names == ("mug",)
        assert finished(verify(catalog, jobs=1)).findings == ()


def test_transaction_without_locks_may_wait_and_one_with_locks_may_not(
    postgres: PostgresServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rig.catalog.postgres.LOST_BENCH_S", 1)
    with opened(place_in(postgres.url, tmp_path / "shared")) as catalog:
        fill(catalog, "mug", 1, 0)
        with catalog.database.read() as reading:
            before = reading.scalar(text("SELECT count(*) FROM views"))
            SystemClock().sleep(1.5)  # an export writes its files
            assert reading.scalar(text("SELECT count(*) FROM views")) == before == 1
        with pytest.raises(CatalogUnavailable), catalog.database.write() as writing:
            SystemClock().sleep(1.5)  # a bench that lost its network
            writing.scalar(text("SELECT count(*) FROM views"))
        assert catalog.objects()


def test_store_that_does_not_answer_is_reported(postgres: PostgresServer, s3: S3Server, tmp_path: Path) -> None:
    with opened(in_s3(postgres, tmp_path / "shared")) as catalog:
        fill(catalog, "mug", 1, 0)
        endpoint = os.environ["AWS_ENDPOINT_URL"]
        s3.stop()
        with pytest.raises(CatalogUnavailable, match="cannot be reached") as error:
            catalog.read_image(catalog.object("mug").views[0].image)
        assert endpoint in str(error.value.evidence)
        assert derived.views(catalog).object_names == ("mug",)
