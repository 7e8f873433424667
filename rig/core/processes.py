"""Applies a function to many items, in this process or in several."""

import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import chain, islice
from multiprocessing import get_context
from typing import Any, Final, TypeVar

from rig.core.errors import RigError
from rig.core.next_steps import Do

_Item = TypeVar("_Item")
_T = TypeVar("_T")
_work: Callable[[Any], object]

_AHEAD: Final = 4
"""Items that are queued for each process, so that none waits for work."""


def map_in_processes(work: Callable[[_Item], _T], items: Iterable[_Item], jobs: int) -> Iterator[tuple[_Item, _T]]:
    """Yield each item with its result, in the order of completion; closing the generator ends the processes.

    There are at most ``jobs`` processes; with 1 the work is done in this process. ``work`` can be pickled, and is sent
    to each process once. The items, which can be hashed and pickled, are read as they are needed.
    """
    waiting = iter(items)
    first = tuple(islice(waiting, jobs))
    jobs, waiting = min(jobs, len(first)), chain(first, waiting)
    if jobs <= 1:
        for item in waiting:
            yield item, work(item)
        return
    # there is a process for each core, so further threads in a process only slow it down
    # and none may import from the working directory (PYTHONSAFEPATH)
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "PYTHONSAFEPATH"):
        os.environ.setdefault(variable, "1")
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), _start_worker, (work,))
    futures: dict[Future[_T], _Item] = {}
    try:
        while True:
            for item in islice(waiting, jobs * _AHEAD - len(futures)):  # read when there is room for them
                with _ignoring_interrupts():  # a submission may start a process
                    futures[pool.submit(_call, item)] = item  # type: ignore[arg-type]
            if not futures:
                break
            for future in wait(futures, return_when=FIRST_COMPLETED).done:
                yield futures.pop(future), future.result()
    except BrokenProcessPool as error:
        raise RigError(
            "A process that worked on the images ended before it was done.",
            next_step=(
                "Check whether the computer ran out of memory. Try it with fewer processes:",
                Do.RUN_AGAIN(jobs=1),
            ),
        ) from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _ignoring_interrupts() -> Iterator[None]:
    """Start processes that ignore Ctrl+C, which a terminal sends to all of its processes.

    The main process receives it after the block, and stops the others when their present item is done.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_worker(work: Callable[[Any], object]) -> None:
    import cv2

    global _work
    _work = work
    cv2.setNumThreads(1)


def _call(item: Any) -> object:
    return _work(item)
