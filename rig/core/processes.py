"""The same work on many items, one after the other or several at once in processes."""

import os
import signal
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any, Final, TypeVar

from rig.core.errors import RigError

_Item = TypeVar("_Item")
_T = TypeVar("_T")
_work: Callable[[Any], object]

#: Items that wait at each process, so that none runs dry; of thousands the rest waits here.
_AHEAD: Final = 4


def map_in_processes(work: Callable[[_Item], _T], items: Iterable[_Item], jobs: int) -> Iterator[tuple[_Item, _T]]:
    """Yield each item with its result, as they come; closing the generator ends the processes.

    Parameters
    ----------
    work
        A function that can be pickled, or a partial of one; it reaches each process once.
    items
        Any that can be hashed and pickled.
    jobs
        How many processes at most; 1 works in this one.
    """
    waiting = deque(items)
    jobs = min(jobs, len(waiting))
    if jobs <= 1:
        for item in waiting:
            yield item, work(item)
        return
    # a process for each core leaves no core for threads of its own
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), _start_worker, (work,))
    futures: dict[Future[_T], _Item] = {}
    try:
        while waiting or futures:
            while waiting and len(futures) < jobs * _AHEAD:
                item = waiting.popleft()
                with _deaf_to_interrupts():  # a submission may start a process
                    futures[pool.submit(_call, item)] = item  # type: ignore[arg-type]
            for future in wait(futures, return_when=FIRST_COMPLETED).done:
                yield futures.pop(future), future.result()
    except BrokenProcessPool as error:
        raise RigError(
            "a process that worked on the images ended before it was done",
            next_step="see whether the computer ran out of memory; go on with fewer processes (--jobs 1)",
        ) from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _deaf_to_interrupts() -> Iterator[None]:
    """Have the processes that are started inherit that they do not hear Ctrl+C, which reaches all of a terminal's.

    The one that the person started hears it when this is over, and stops the others after the item they are at.
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
