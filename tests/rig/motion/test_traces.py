"""The traces of the last moves: what a move leaves, how many are kept, and the page that draws them."""

from pathlib import Path

import numpy as np
import pytest

from rig.core.errors import Stalled, StateNotStored
from rig.motion.traces import FILE, KEPT, stored
from rig.motion.turntable import Turntable
from tests.rig.bench_parts import LAG_S, at_rest, motion_bench


def test_trace_has_angle_rate_and_load_of_the_whole_move():
    with motion_bench() as (bench, wires):
        with Turntable(bench) as table:
            table.goto(90.0)
            assert stored(bench.state) == []  # nothing is written while the table has torque
            table.goto(60.0)
        first, second = stored(bench.state)
    assert [goal[1] for goal in first["goals"]] == [90.0]
    assert [goal[1] for goal in second["goals"]] == [57.0, 60.0]  # from below
    assert first["encoder_deg"][-1] == at_rest(wires.device, 90.0, 0.1)
    behind_deg = np.subtract(first["profile_deg"], first["encoder_deg"])
    # In motion, friction adds to the lag what it adds at rest.
    lag_deg = LAG_S * bench.config.table.velocity_dps
    assert max(behind_deg) == pytest.approx(lag_deg + wires.device.motor.held_deg, abs=0.2)
    assert min(behind_deg) > -0.2
    assert max(map(abs, first["load_percent"])) > 3
    assert np.trapezoid(first["gyro_dps"], first["gyro_s"]) == pytest.approx(90.0, rel=0.03)
    assert 0 < first["settled_s"] - first["arrived_s"] < 1


def test_failed_move_leaves_its_trace_and_the_last_moves_are_kept():
    with motion_bench() as (bench, wires):
        for _ in range(2):
            with Turntable(bench) as table:
                for target in range(KEPT):
                    table.goto(5.0 + target)
        with Turntable(bench) as table, pytest.raises(Stalled):
            wires.device.motor.jam()
            table.goto(90.0)
        moves = stored(bench.state)
        assert len(moves) == KEPT
        assert [move["settled_s"] is None for move in moves] == [False] * (KEPT - 1) + [True]
        bench.state.store_file(FILE, b"{")
        with pytest.raises(StateNotStored, match="damaged"):
            stored(bench.state)


def test_page_draws_the_moves_of_a_bench(rig):
    assert rig("report", "--motion").exit_code == 2
    assert rig("goto", "20").exit_code == 0
    assert rig("report", "--motion").exit_code == 0
    page = Path("motion.html").read_text(encoding="utf-8")
    assert "from 0.0° to 20.0°" in page
    assert page.count("<svg") == 5
    assert rig("report").exit_code == rig("report", "runs/1", "--motion").exit_code == 2
