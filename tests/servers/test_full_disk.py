"""The disk under the journal gets full at any point of an enrollment and of a delivery: nothing is lost or doubled.

The disk is a real one: a tmpfs of two megabytes that a program of the test mounts for itself.
"""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from rig.catalog import Catalog
from rig.catalog.jobs import finished
from rig.catalog.journal import Journal, deliver, waiting
from rig.catalog.results import find_results
from rig.catalog.results import record as record_result
from rig.catalog.verify import verify
from rig.config.catalog_place import CatalogPlace
from rig.core.clock import SystemClock
from rig.core.errors import CatalogError
from rig.core.next_steps import Do
from tests.rig.catalog.catalog_samples import PROVENANCE, image, new_result, plan, record
from tests.servers.postgres import place_in, server

CLOCK = SystemClock()
SIZE = 2 << 20
VIEWS = 3
MOST = 180_000
"""Bytes that are enough for an object."""
MOUNTED = 'mount -t tmpfs -o size={size} tmpfs "$0" && exec "$@"'
AS_ROOT = () if os.geteuid() == 0 else ("--map-root-user",)
NAMESPACE = ("unshare", *AS_ROOT, "--mount", "sh", "-c", MOUNTED.format(size=SIZE))


@contextmanager
def only_free(folder: Path, free_bytes: int) -> Iterator[None]:
    """Fill the disk of a folder but for a rest."""
    filler = folder / "filler"
    disk = os.statvfs(folder)
    with filler.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, max(1, disk.f_bavail * disk.f_frsize - free_bytes))
    try:
        yield
    finally:
        filler.unlink()


def full(action: Callable[[], object]) -> bool:
    """Do something; return whether the disk was too full for it."""
    try:
        action()
    except CatalogError as error:
        if "is full" in error.what and "earlier ones are safe" in error.what and Do.FREE_DISK() in error.steps:
            return True
        raise
    return False


def take(journal: Journal, name: str, number: int) -> None:
    """Take the views of an object that the journal does not have, and complete it."""
    known = {one.name: one for one in journal.objects()}.get(name)
    if known is None:
        enrollment = journal.begin(name, planned_azimuth_deg=plan(VIEWS), provenance=PROVENANCE)
    elif known.unfinished_views is not None:
        enrollment = journal.resume(name, provenance=PROVENANCE)
        assert len(enrollment.missing()) == VIEWS - known.unfinished_views
    else:
        return
    for index in enrollment.missing():
        enrollment.add(record(index), image(VIEWS * number + index))
    enrollment.finish()


def fill_the_disk() -> None:
    """Enroll, record an answer and deliver with less and less space; then with enough. Print what happened."""
    folder, url, images, step = sys.argv[1:5]
    place = CatalogPlace(Path(folder) / "bench", url, images)
    with Journal.of(place, CLOCK) as journal, Catalog.open(place, clock=CLOCK) as shared:
        assert deliver(journal, shared) == []
    failures = {"enroll": 0, "answer": 0, "deliver": 0}
    sizes = range(0, MOST, int(step))
    for number, free_bytes in enumerate(sizes):
        name = f"object {number}"
        for what in failures:
            with Journal.of(place, CLOCK) as journal, Catalog.open(place, clock=CLOCK) as shared:
                action: Callable[[], object] = {
                    "enroll": lambda journal=journal, name=name, number=number: take(journal, name, number),
                    "answer": lambda journal=journal, name=name: record_result(
                        journal, new_result("found", name), image(1)
                    ),
                    "deliver": lambda journal=journal, shared=shared: deliver(journal, shared),
                }[what]
                with only_free(place.path, free_bytes):
                    failed = full(action)
                failures[what] += failed
                if failed:
                    action()
        assert waiting(place, CLOCK) == 0, name
    with Catalog.open(place, clock=CLOCK) as shared:
        assert {one.name: one.views for one in shared.objects()} == {f"object {n}": VIEWS for n in range(len(sizes))}
        answers = [one.current.object_name for one in find_results(shared)]
        assert answers == [f"object {n}" for n in range(len(sizes))]
        assert finished(verify(shared, jobs=1)).findings == ()
    print(f"{len(sizes)} sizes, full at {failures}")
    assert all(failures.values())


@pytest.mark.parametrize("step", [20_480, pytest.param(4096, marks=pytest.mark.nightly)])
def test_full_disk_under_the_journal_loses_and_doubles_nothing(tmp_path: Path, step: int) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    try:
        subprocess.run([*NAMESPACE, disk, "true"], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no file system can be mounted here: {error}")
    with server() as running:
        place = place_in(running.url, tmp_path / "catalog", str(tmp_path / "shared"))
        code = "from tests.servers.test_full_disk import fill_the_disk; fill_the_disk()"
        words = [disk, str(place.url), str(place.images), str(step)]
        done = subprocess.run(
            [*NAMESPACE, disk, sys.executable, "-c", code, *words], capture_output=True, text=True, check=False
        )
        print(done.stdout)
        assert done.returncode == 0, done.stderr
