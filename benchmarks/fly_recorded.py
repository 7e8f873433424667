"""Searches in motion compared with searches at rest, computed from frames that were recorded once.

`python -m benchmarks.fly_recorded RECORDING [--trials 240] [--seed 0] [--strength 0] [--objects 40] [--json FILE]`

`benchmarks.fly_search` runs both searches on the simulated bench, which draws some 50 frames for each. Here each
built-in object is recorded once: 24 views at rest, which are enrolled, and, after the object was placed again, a
revolution in motion and 24 views at rest, which are searched for. RECORDING stores the descriptions. The searches are
those of the bench (`rig.search.session`); their times come from the motion profile, not from a bench.

Each of four catalogs leaves out four objects that are unknown then; one search in five is for one of these. With
``--strength`` the descriptions change as those of another bench would (`hbr.descriptors.base`).
"""

import argparse
import json
import pickle
from math import copysign, sqrt
from pathlib import Path
from typing import Any

import numpy as np

import hbr
from benchmarks.fly_enrollment import NOISE, value_of
from benchmarks.fly_search import summary
from hbr.core.angles import size_deg
from hbr.descriptors.base import Shift
from rig.bench import Bench
from rig.config import RigConfig, load_config
from rig.devices.camera import Frame
from rig.motion.flight_views import FlightFrames
from rig.motion.move import MotionModel, equivalent_within
from rig.motion.turntable import Turntable
from rig.plans.capture import capture
from rig.search.model import Model, begin_search
from rig.search.strategies import Finish
from rig.views.capture import Viewer
from rig.views.description import BENCH_DESCRIPTOR, DescribedView, ViewDescriber
from rig.views.stream import middle_ns
from sim.bench import ShelfOperator, open_sim_bench
from sim.objects.shelf import shelf
from sim.world import World

VIEWS = 24
CATALOGS = 4
LEFT_OUT = 4
UNKNOWN_EVERY = 5
FIRST_VIEW_S = {"rest": 0.95, "motion": 0.33}
"""Bench time until the first decision (`benchmarks.fly_search`)."""
Seen = list[tuple[float, Any]]
"""Table angles and descriptions."""


def configured() -> RigConfig:
    """Return a configuration in which the camera's time is known; no bench is used for the searches."""
    return load_config(None, ("camera_time.offset_ms=1", "camera_time.jitter_ms=0.2"))


def record(bench: Bench, operator: ShelfOperator, name: str) -> dict[str, Seen]:
    """Record one object: views to enroll, a revolution in motion, and views at rest."""
    describe = ViewDescriber(bench.config.view, (BENCH_DESCRIPTOR,))
    viewer = Viewer(bench.camera, bench.config.view)
    found: dict[str, Seen] = {}
    for kind in ("enrolled", "rest"):
        operator.next_object, operator.yaw_deg = name, 0.0 if kind == "enrolled" else 5.0
        bench.place(None)
        with Turntable(bench) as table:
            start_deg, step_deg = 0.0, 360.0 / VIEWS
            if kind == "rest":
                found["motion"] = revolution(bench, table, describe)
                start_deg, step_deg = 360.0, -step_deg
            found[kind] = []
            for number in range(VIEWS):
                move = table.goto(start_deg + number * step_deg)
                attempt = value_of(capture(number, viewer, table, move.settled_ns))
                found[kind].append((table.rest_deg, describe(attempt.image_bgr).levels[BENCH_DESCRIPTOR]))
            table.goto(0.0)
    return found


def revolution(bench: Bench, table: Turntable, describe: ViewDescriber) -> Seen:
    """Rotate once, and return the frames at full speed."""
    table.goto(0.0)
    frames = FlightFrames(bench, table)
    seen: list[tuple[int, Any]] = []

    def take(frame: Frame) -> None:
        middle = middle_ns(frame.exposed_ns, bench.config.camera_time)
        seen.append((middle, describe(frame.image_bgr).levels[BENCH_DESCRIPTOR]))

    speed = bench.config.table.velocity_dps
    table.fly(360.0, frames.flight(take, (0.0, 360.0), speed))
    trajectory = frames.recorder.fit()
    assert trajectory is not None
    motion = trajectory.at([at for at, _ in seen])
    steady = np.abs(motion.rate_dps) > 0.9 * speed
    return [(float(motion.angle_deg[k]), seen[k][1]) for k in np.flatnonzero(steady)]


def nearest(seen: Seen, angle_deg: float) -> tuple[float, Any]:
    """Return the description of the nearest angle."""
    return seen[int(size_deg(np.array([at for at, _ in seen]) - angle_deg).argmin())]


def search(model: Model, config: RigConfig, seen: dict[str, Seen], start_deg: float, kind: str) -> dict[str, Any]:
    """Search for a recorded object from a table angle on; return the answer."""
    sign, limits_deg = config.table.orientation_sign, config.table.limits_deg
    times, ramp = MotionModel(config), config.table.acceleration_dps2
    session = begin_search(model, config, "dense" if kind == "rest" else "arc")
    table_deg, travelled_deg, seconds, step_s = 0.0, 0.0, FIRST_VIEW_S[kind], 1 / config.camera.fps
    while True:
        at_deg, levels = nearest(seen["rest"], start_deg + table_deg)
        _, step = session.add(DescribedView({BENCH_DESCRIPTOR: levels}, None), sign * at_deg % 360, table_deg=table_deg)
        if isinstance(step, Finish):
            break
        goal_deg = equivalent_within(table_deg + sign * step.rotation_deg, table_deg, limits_deg)
        assert goal_deg is not None
        if not session.in_motion:
            seconds += times.move_s(goal_deg - table_deg) + times.view_s
            travelled_deg += abs(goal_deg - table_deg)
            table_deg = goal_deg
            continue
        rate_dps = 0.0
        while abs(goal_deg - table_deg) > 1.0 or abs(rate_dps) > 20.0:
            wanted = min(config.table.velocity_dps, sqrt(2 * ramp * abs(goal_deg - table_deg)))
            change = copysign(wanted, goal_deg - table_deg) - rate_dps
            rate_dps += min(max(change, -ramp * step_s), ramp * step_s)
            table_deg += rate_dps * step_s
            travelled_deg, seconds = travelled_deg + abs(rate_dps) * step_s, seconds + step_s
            at_deg, levels = nearest(seen["motion"], start_deg + table_deg)
            _, step = session.add(
                DescribedView({BENCH_DESCRIPTOR: levels}, None), sign * at_deg % 360, table_deg=table_deg
            )
            if isinstance(step, Finish):
                break
            if session.is_new_decision:
                goal_deg = min(max(table_deg + sign * step.rotation_deg, limits_deg[0]), limits_deg[1])
        if isinstance(step, Finish):
            break
        table_deg, seconds = goal_deg, seconds + 0.3  # the table has arrived and is at rest
    answer = session.answer(travelled_deg=travelled_deg, seconds=seconds)
    found = answer.name if answer.outcome is hbr.Outcome.FOUND else answer.outcome.value
    return {"found": found, "seconds": seconds, "views": answer.views, "travelled_deg": travelled_deg}


def changed(seen: dict[str, Seen], rng: np.random.Generator, strength: float) -> dict[str, Seen]:
    """Return the description as of another bench."""
    shift, kind = Shift.drawn(rng, strength), hbr.descriptor(BENCH_DESCRIPTOR)
    return {name: [(at, kind.shifted(levels, shift)) for at, levels in part] for name, part in seen.items()}


def main() -> None:
    options = argparse.ArgumentParser()
    options.add_argument("recording", type=Path)
    options.add_argument("--trials", type=int, default=240)
    options.add_argument("--objects", type=int, default=40)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--strength", type=float, default=0.0)
    options.add_argument("--json", type=Path)
    given = options.parse_args()
    if not given.recording.exists():
        things = shelf()
        operator = ShelfOperator(World(seed=11, noise=NOISE), things)
        with open_sim_bench(configured(), operator) as bench:
            recorded = {name: record(bench, operator, name) for name in list(things)[: given.objects]}
        given.recording.write_bytes(pickle.dumps(recorded))
    recorded = pickle.loads(given.recording.read_bytes())
    names, config, rng = sorted(recorded), configured(), np.random.default_rng(given.seed)
    rows: list[dict[str, Any]] = []
    for number in range(CATALOGS):
        unknown = names[number :: 2 * CATALOGS][:LEFT_OUT]
        known = [name for name in names if name not in unknown]
        seen = [(j, at, levels) for j, name in enumerate(known) for at, levels in recorded[name]["enrolled"]]
        objects, angles, levels = zip(*seen, strict=True)
        azimuths = config.table.orientation_sign * np.array(angles) % 360
        index = hbr.DenseIndex(hbr.Views(np.array(levels), azimuths, np.array(objects), tuple(known), BENCH_DESCRIPTOR))
        model = Model(index, hbr.fit_stopping_rule(index).rule)
        for trial in range(given.trials // CATALOGS):
            name = str(rng.choice(unknown if trial % UNKNOWN_EVERY == UNKNOWN_EVERY - 1 else known))
            shown = changed(recorded[name], rng, given.strength) if given.strength else recorded[name]
            start_deg = float(rng.uniform(0, 360))
            row: dict[str, Any] = {"object": name, "known": name in known}
            for kind in ("rest", "motion"):
                row[kind] = search(model, config, shown, start_deg, kind)
                row[kind]["right"] = row[kind]["found"] == (name if row["known"] else "unknown")
            rows.append(row)
    print(json.dumps(summary(rows), indent=2))
    if given.json:
        given.json.write_text(json.dumps({"summary": summary(rows), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
