"""docs/how-to/add-a-strategy.md"""

import pytest

from rig import Catalog, enroll
from tests.docs.pages import blocks, run


@pytest.mark.nightly
def test_new_strategies_find_the_object(tmp_path, simulated):
    page = run("\n".join(blocks("add-a-strategy")))
    bench = simulated(seed=3)
    with Catalog.open(tmp_path, clock=bench.bench.clock) as catalog:
        for name in ("toy-car", "book-night"):
            list(enroll(bench.bench, catalog, name, views=8))
        bench.operator.next_object = "book-night"
        for strategy in ("Golden", "FarSide"):
            assert page["find"](bench.bench, catalog, page[strategy]()).name == "book-night"
