"""Applies a function to many items on a Dask cluster."""

import pickle
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256
from typing import Any, Final, TypeVar

from rig.core.errors import ClusterFailed, ExtraMissing, UsageError
from rig.core.next_steps import Do
from rig.core.phrases import whole

_Item = TypeVar("_Item")
_T = TypeVar("_T")

LOCAL: Final = "local"
START_S: Final = 30  # a busy computer starts a worker process in seconds; longer: a wrong address is noticed late

_LOCAL: dict[int, Any] = {}
"""The clusters that this program started, by their number of workers. Dask ends them with the program."""


@dataclass(frozen=True)
class Cluster:
    """A Dask cluster.

    ``address`` is that of its scheduler, ``tcp://HOST:8786``; or ``local`` or ``local:WORKERS`` to start one on this
    computer.
    """

    address: str

    def workers(self) -> int | None:
        """Return how many workers to start on this computer; None for a cluster that runs already.

        Raises `UsageError`: the number is not valid.
        """
        name, _, count = self.address.partition(":")
        if name != LOCAL:
            return None
        if count and not whole(count):
            raise UsageError(f"--cluster {self.address!r}: {count!r} is not a number.", next_step="Give local:2.")
        return int(count or 0)


def map_on_cluster(work: Callable[[_Item], _T], items: Iterable[_Item], cluster: Cluster) -> Iterator[tuple[_Item, _T]]:
    """Yield each item with its result, in the order of completion; closing the generator ends the tasks.

    The workers need this program in the same version, and the same files under the same names. If a worker dies, other
    workers repeat its items.

    ``work`` and ``items`` can be pickled. Each worker gets ``work`` once.

    Raises `ClusterFailed`: the cluster does not answer, or an item ended several workers.
    """
    todo = list(items)
    if not todo:
        return
    try:
        from distributed import Client, KilledWorker, as_completed
    except ImportError as error:
        raise ExtraMissing.of("cluster", "jobs on a cluster", error) from error

    with ExitStack() as ends:
        try:
            count = cluster.workers()
            where: Any = cluster.address if count is None else _local_cluster(count)
            client = ends.enter_context(Client(where, timeout=START_S))
        except (OSError, TimeoutError, ValueError) as error:
            raise ClusterFailed(
                f"The cluster {cluster.address} does not answer.",
                next_step=(
                    "Start its scheduler and workers (dask scheduler, dask worker), or",
                    Do.RUN_AGAIN(cluster="local"),
                ),
                evidence={"error": str(error)},
            ) from error
        # The work is sent once.
        content = pickle.dumps(work)
        digest = sha256(content).hexdigest()
        # A task instead of data that is sent to workers: the scheduler repeats a task if its worker dies.
        shared = client.submit(bytes, content, key=f"rig-work-{digest}", pure=True)
        futures = {
            client.submit(_call, shared, digest, item, pure=False, key=f"rig-{digest[:12]}-{number}"): item
            for number, item in enumerate(todo)
        }
        try:
            for future in as_completed(futures):
                item = futures.pop(future)
                yield item, future.result()
                future.release()
        except KilledWorker as error:
            raise ClusterFailed(
                "An item ended several workers of the cluster.",
                next_step="Check whether the workers ran out of memory, and try again.",
                evidence={"error": str(error)},
            ) from error
        finally:
            for future in futures:
                future.cancel()


def _local_cluster(count: int) -> Any:
    """Return a cluster on this computer; its start takes seconds, so that it works until the program ends."""
    from distributed import LocalCluster

    running = _LOCAL.get(count)
    if running is None or running.status.name != "running":
        running = _LOCAL[count] = LocalCluster(
            n_workers=count or None, threads_per_worker=1, dashboard_address=None, silence_logs=50
        )
    return running


def _call(content: bytes, digest: str, item: Any) -> Any:
    return _loaded(_Content(content, digest))(item)


@dataclass(frozen=True)
class _Content:
    content: bytes
    digest: str

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Content) and other.digest == self.digest

    def __hash__(self) -> int:
        return hash(self.digest)


@lru_cache(maxsize=2)
def _loaded(content: _Content) -> Callable[[Any], Any]:
    """Return the function in this worker."""
    import cv2

    cv2.setNumThreads(1)
    found: Callable[[Any], Any] = pickle.loads(content.content)
    return found
