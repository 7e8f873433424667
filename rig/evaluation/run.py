"""Carries a plan out, one object after the other or several at once in processes."""

import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import suppress
from functools import partial
from multiprocessing import get_context
from typing import TypeVar

import cv2

from hbr.arrays import LevelArray
from hbr.evaluation.descriptors import enrolled_levels, query_levels
from hbr.evaluation.protocol import Runs, run_object
from hbr.views import Views
from rig.clock import SystemClock
from rig.evaluation.plan import Plan
from rig.evaluation.store import Store

_T = TypeVar("_T")
_work: Callable[[int], object]


def enrolled_views(plan: Plan, jobs: int, advance: Callable[[str], None]) -> Views:
    """Describe every photograph as it is enrolled; `advance` is called with the name of each object.

    Raises
    ------
    DatasetError
        A photograph cannot be used.
    """
    objects = plan.dataset.objects
    levels: dict[int, LevelArray] = {}
    for j, found in _over_processes(partial(_enroll, plan), range(len(objects)), jobs):
        levels[j] = found
        advance(objects[j].name)
    return Views.concatenate(
        [Views.of_object(item.name, levels[j], item.azimuth_deg) for j, item in enumerate(objects)]
    )


def run_plan(plan: Plan, views: Views, store: Store, jobs: int, advance: Callable[[str], None]) -> Runs:
    """Search for every object that the store has no runs of, and return the runs of all.

    The results do not depend on `jobs`; `advance` is called with the name of each object. Whatever ends the call, the
    store keeps the objects that were done.

    Raises
    ------
    DatasetError, ValueError
        A photograph cannot be used, or an object has too few views for the protocol.
    """
    names = [item.name for item in plan.dataset.objects]
    done: dict[int, Runs] = {}
    for j, name in enumerate(names):
        if (runs := store.load(name)) is not None:
            done[j] = runs
            advance(name)
    missing = [j for j in range(len(names)) if j not in done]
    for j, runs in _over_processes(partial(_search, plan, views), missing, jobs):
        store.save(names[j], runs)
        done[j] = runs
        advance(names[j])
    return Runs.concatenate([done[j] for j in range(len(names))])


def _enroll(plan: Plan, j: int) -> LevelArray:
    return enrolled_levels(plan.dataset, j, plan.condition, plan.size)


def _search(plan: Plan, views: Views, j: int) -> Runs:
    queries = query_levels(plan.dataset, j, plan.condition, plan.size, plan.protocol.seed)
    return run_object(j, queries, views, plan.methods, plan.protocol, now_ns=SystemClock().now_ns)


def _over_processes(work: Callable[[int], _T], items: Iterable[int], jobs: int) -> Iterator[tuple[int, _T]]:
    """Yield each item with its result, as they come."""
    waiting = list(items)
    jobs = min(jobs, len(waiting))
    if jobs <= 1:
        for item in waiting:
            yield item, work(item)
        return
    # a process for each core leaves no core for threads of its own
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), _start_worker, (work,))
    try:
        futures: dict[Future[_T], int] = {pool.submit(_call, item): item for item in waiting}  # type: ignore[arg-type]
        while futures:
            for future in wait(futures, return_when=FIRST_COMPLETED).done:
                yield futures.pop(future), future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _start_worker(work: Callable[[int], object]) -> None:
    global _work
    _work = work
    cv2.setNumThreads(1)
    # Ctrl+C reaches every process of the terminal; the first one stops the others after the object they are at
    with suppress(ValueError):
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _call(item: int) -> object:
    return _work(item)
