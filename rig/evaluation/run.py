"""Run a plan, with several objects in parallel processes."""

from collections.abc import Callable
from functools import partial

from hbr.core.arrays import LevelArray
from hbr.dense.stopping import StoppingRule
from hbr.evaluation.descriptors import enrolled_levels, segmented_queries
from hbr.evaluation.near_twins import LocalPhotographs
from hbr.evaluation.protocol import Runs
from hbr.evaluation.trials import rule_of_trial, run_object
from hbr.model.views import Views
from rig.core.clock import SystemClock
from rig.core.processes import Jobs, map_in_processes
from rig.evaluation.plan import Plan
from rig.evaluation.store import Store


def enrolled_views(plan: Plan, jobs: Jobs, advance: Callable[[str], None]) -> Views:
    """Return the descriptors of all photographs as enrolled views; `advance` is called with each object's name.

    Raises
    ------
    DatasetError
        A photograph cannot be used.
    """
    objects = plan.dataset.objects
    levels: dict[int, LevelArray] = {}
    for j, found in map_in_processes(partial(_enroll, plan), range(len(objects)), jobs):
        levels[j] = found
        advance(objects[j].name)
    return Views.concatenate(
        [
            Views.of_object(item.name, levels[j], item.azimuth_deg, plan.condition.descriptor)
            for j, item in enumerate(objects)
        ]
    )


def run_plan(plan: Plan, views: Views, store: Store, jobs: Jobs, advance: Callable[[str], None]) -> Runs:
    """Search for every object that has no stored runs, and return the runs of all objects.

    The results do not depend on `jobs`. `advance` is called with the name of each object. If the call is interrupted,
    the runs of the completed objects are in the store.

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
    dense = any(method.dense for method in plan.methods)
    rule = rule_of_trial(views, plan.protocol) if missing and dense else None
    for j, runs in map_in_processes(partial(_search, plan, views, rule), missing, jobs):
        store.save(names[j], runs)
        done[j] = runs
        advance(names[j])
    return Runs.concatenate([done[j] for j in range(len(names))])


def _enroll(plan: Plan, j: int) -> LevelArray:
    return enrolled_levels(plan.dataset, j, plan.condition, plan.size)


def _search(plan: Plan, views: Views, rule: StoppingRule | None, j: int) -> Runs:
    queries, methods = segmented_queries(plan.dataset, j, plan.condition, plan.size, plan.protocol.seed)
    photographs = LocalPhotographs(plan.dataset, plan.condition, plan.size, plan.protocol.seed)
    return run_object(
        j,
        queries,
        views,
        plan.methods,
        plan.protocol,
        rule=rule,
        photographs=photographs if photographs.possible else None,
        same_bench=plan.condition.same_bench,
        segmented_by=methods,
        now_ns=SystemClock().now_ns,
    )
