"""docs/how-to/add-a-simulated-fault.md"""

import pytest

from rig.catalog import Catalog
from rig.config import load_config
from sim.bench import ShelfOperator, open_sim_bench
from sim.faults import Fault, fault_kinds, kind
from sim.objects.shelf import shelf
from sim.world import World
from tests.docs.pages import blocks, run


@pytest.fixture
def page():
    before = dict(kind.registry)
    code, test = blocks("add-a-simulated-fault")
    run(code)
    yield run(test)
    kind.registry.clear()
    kind.registry.update(before)


def test_new_fault_happens_on_the_simulated_bench(page, tmp_path):
    test = page["test_enrollment_rejects_dark_views"]
    (mark,) = test.pytestmark
    operator = ShelfOperator(World(seed=1), shelf())
    faults = [Fault.parse(text) for text in mark.kwargs["faults"]]
    with (
        open_sim_bench(load_config(), operator, faults=faults) as bench,
        Catalog.open(tmp_path, clock=bench.clock) as catalog,
    ):
        test(bench, catalog)
    assert "lamp_dims" in fault_kinds()
