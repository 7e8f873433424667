"""A stored view survives a killed process, a full disk and other processes that use the same catalog."""

import errno
import os
import signal
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import Engine, event

from rig.catalog import Catalog, OpenEnrollment
from rig.catalog.derived import views as searched
from rig.catalog.images import Images, name_of
from rig.catalog.jobs import finished
from rig.catalog.sqlite_database import SqliteDatabase
from rig.catalog.upkeep import collect_garbage
from rig.catalog.verify import verify
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import SystemClock
from rig.core.errors import CatalogBusy, CatalogError
from rig.core.next_steps import Do
from rig.views.image_files import encode
from sim.clock import VirtualClock
from tests.rig.catalog.catalog_samples import PROVENANCE, fill, image, other_program, plan, record

VIEWS = 12


def begin(catalog: Catalog, name: str, views: int = VIEWS) -> OpenEnrollment:
    return catalog.begin(name, planned_azimuth_deg=plan(views), provenance=PROVENANCE)


def assert_resumes_whole(path: Path, name: str, reported: set[int]) -> None:
    """Check that every reported view is stored, at most one more is, and all of them with their pixels."""
    with Catalog.open(path, clock=VirtualClock()) as catalog:
        unfinished = catalog.resumable(name)
        assert unfinished is not None
        assert reported <= set(unfinished.enrollment.present)
        assert len(unfinished.enrollment.present) <= len(reported) + 1
        enrollment = catalog.resume(name, provenance=PROVENANCE)
        for index in enrollment.missing():
            enrollment.add(record(index), image(index))
        enrollment.finish()
        views = catalog.object(name).views
        assert [view.index for view in views] == list(range(VIEWS))
        for view in views:
            assert np.array_equal(catalog.read_image(view.image), image(view.index))
        others = catalog.database.images.names() - {view.image for view in views}
        assert all(name.endswith(".part") for name in others)  # `collect_garbage` removes it
        assert len(others) <= 1
        assert finished(verify(catalog, jobs=1)).findings == ()


@pytest.mark.parametrize("die_before", [9, 10, 11, 12], ids=["sync-image", "rename", "sync-folder", "commit"])
def test_process_killed_in_add_loses_only_that_view(tmp_path: Path, die_before: int) -> None:
    child = other_program(tmp_path, "mug", VIEWS, die_before)
    out, err = child.communicate()
    assert child.returncode == -signal.SIGKILL, err
    assert out.split() == ["0"]
    assert_resumes_whole(tmp_path, "mug", {0})


def test_image_is_durable_before_its_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[str] = []
    fsync, replace = os.fsync, os.replace

    def record_fsync(descriptor: int) -> None:
        steps.append(f"sync {Path(f'/proc/self/fd/{descriptor}').readlink().name}")
        fsync(descriptor)

    def record_replace(source: Path, target: Path) -> None:
        steps.append(f"rename {source.name} {target.name}")
        replace(source, target)

    def record_commit(_: object) -> None:
        steps.append("commit")

    with Catalog.open(tmp_path, clock=VirtualClock()) as catalog:
        enrollment = begin(catalog, "mug")
        monkeypatch.setattr(os, "fsync", record_fsync)
        monkeypatch.setattr(os, "replace", record_replace)
        event.listen(Engine, "commit", record_commit)
        try:
            enrollment.add(record(0), image(0))
        finally:
            event.remove(Engine, "commit", record_commit)
    (name,) = (path.name for path in tmp_path.rglob("*.png"))
    part = next(step.removeprefix("sync ") for step in steps if step.endswith(".part"))
    assert part.startswith(name)
    stored = [f"sync {part}", f"rename {part} {name}", f"sync {name[:2]}", "commit"]
    assert [step for step in steps if step in stored] == stored == steps[-len(stored) :]


@pytest.mark.sqlite
def test_database_commits_durably_and_checks_foreign_keys(tmp_path: Path) -> None:
    database = SqliteDatabase(CatalogPlace(tmp_path), create=True, read_only=False, busy_timeout_s=1.0)
    with database.write() as transaction:
        settings = {
            name: transaction.connection().exec_driver_sql(f"PRAGMA {name}").scalar_one()
            for name in ("journal_mode", "synchronous", "foreign_keys")
        }
    database.close()
    assert settings == {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1}


def fail_fsync(_: int) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def fail_replace(_source: Path, _target: Path) -> None:
    raise OSError(errno.EDQUOT, os.strerror(errno.EDQUOT))


@pytest.mark.parametrize(("call", "failure"), [("fsync", fail_fsync), ("replace", fail_replace)])
def test_full_disk_loses_only_the_present_view(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str, failure: Callable[..., Any]
) -> None:
    with Catalog.open(tmp_path, clock=VirtualClock()) as catalog:
        enrollment = begin(catalog, "mug", 2)
        enrollment.add(record(0), image(0))
        with monkeypatch.context() as patch:
            patch.setattr(os, call, failure)
            with pytest.raises(CatalogError, match=r"full.*earlier ones are safe") as error:
                enrollment.add(record(1), image(1))
        assert Do.FREE_DISK() in error.value.steps
        assert enrollment.missing() == (1,)
        assert len([path for path in tmp_path.joinpath("images").rglob("*") if path.is_file()]) == 1
        enrollment.add(record(1), image(1))
        enrollment.finish()


@pytest.mark.sqlite
def test_database_that_cannot_grow_is_reported_as_full_disk(tmp_path: Path) -> None:
    with Catalog.open(tmp_path, clock=VirtualClock()) as catalog:
        enrollment = begin(catalog, "mug", 1)
        with catalog.database.write() as transaction:
            pages = transaction.connection().exec_driver_sql("PRAGMA page_count").scalar_one()
            transaction.connection().exec_driver_sql(f"PRAGMA max_page_count = {pages}")
        with pytest.raises(CatalogError, match="full"):
            enrollment.add(record(0, evidence={"long": "x" * 20_000}), image(0))
        assert enrollment.missing() == (0,)


def test_begin_fails_if_the_empty_table_image_cannot_be_stored(tmp_path: Path) -> None:
    with Catalog.open(tmp_path, clock=VirtualClock()) as catalog:
        (tmp_path / "images").write_text("in the way")
        with pytest.raises(CatalogError):
            catalog.begin("mug", planned_azimuth_deg=plan(1), provenance=PROVENANCE, empty_table=image(0))
        assert catalog.objects() == []


@pytest.mark.sqlite
def test_second_writer_gets_busy_error_after_the_timeout(tmp_path: Path) -> None:
    with Catalog.open(tmp_path, clock=VirtualClock(), busy_timeout_s=0.02) as catalog:
        fill(catalog, "tin", 1)
        enrollment = begin(catalog, "mug", 1)
        with closing(sqlite3.connect(tmp_path / "catalog.sqlite", isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            with pytest.raises(CatalogBusy, match=r"0\.02 s\. Nothing was changed") as error:
                enrollment.add(record(0), image(0))
            assert error.value.exit_code == 9
            assert len(searched(catalog)) == 1  # readers do not wait
        enrollment.add(record(0), image(0))


def test_several_processes_share_one_catalog(tmp_path: Path) -> None:
    path = tmp_path / "new" / "catalog"
    children = {name: other_program(path, name, VIEWS) for name in ("mug", "tin")}
    for child in children.values():
        assert child.stdout is not None
        first = child.stdout.readline()
        assert first == "0\n", child.communicate()
    seen = [0]
    with Catalog.open(path, clock=VirtualClock(), read_only=True) as catalog:
        while any(child.poll() is None for child in children.values()):
            summaries = catalog.objects()
            seen.append(sum(s.views + (s.unfinished_views or 0) for s in summaries))
            assert len(searched(catalog)) in (0, VIEWS, 2 * VIEWS)
        for child in children.values():
            _, err = child.communicate()
            assert child.returncode == 0, err
        assert seen == sorted(seen)
        assert sorted(searched(catalog).object_names) == ["mug", "tin"]
        for name in children:
            for view in catalog.object(name).views:
                assert np.array_equal(catalog.read_image(view.image), image(view.index))


def test_processes_that_store_the_same_image_do_not_disturb_each_other(tmp_path: Path) -> None:
    """All sessions of a bench store the same empty-table image."""
    contents = [encode(image(seed)) for seed in range(30)]
    store = Images(tmp_path)
    children = []
    for _ in range(3):
        if (child := os.fork()) == 0:
            try:
                for content in contents:
                    store.put(content)
                os._exit(0)
            finally:
                os._exit(1)
        children.append(child)
    running = set(children)
    while running:
        for name in store.names():
            if name.endswith(".png"):
                store.content(name)  # it is complete
        running -= {child for child in running if os.waitpid(child, os.WNOHANG) == (child, 0)}
    assert store.names() == {name_of(content) for content in contents}


def test_an_image_that_is_collected_before_its_row_is_stored_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A deleted object had the same image, and another process removes it between the image and the row."""
    with Catalog.open(tmp_path, clock=SystemClock()) as catalog, Catalog.open(tmp_path, clock=SystemClock()) as other:
        fill(catalog, "gone", 1)
        catalog.delete("gone")
        enrollment = begin(catalog, "mug", 1)
        put = Images.put

        def put_and_collect(store: Images, content: bytes, *, settled: bool = True) -> str:
            name = put(store, content, settled=settled)
            monkeypatch.setattr(Images, "put", put)
            assert collect_garbage(other).files == 1
            return name

        monkeypatch.setattr(Images, "put", put_and_collect)
        enrollment.add(record(0), image(0))
        enrollment.finish()
        assert np.array_equal(catalog.read_image(catalog.object("mug").views[0].image), image(0))
        assert finished(verify(catalog, jobs=1)).findings == ()
