"""The emulated head in lock-step with the virtual clock: equal to the cycle for any division of the run."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from rig.core.errors import RigError
from rig.devices.head.protocol import Reset
from sim.head import board
from sim.motion import to_position
from sim.noise import NoiseModel
from tests.contract.heads import opened_head

KINDS = ["memory", pytest.param("avr", marks=pytest.mark.nightly)]


@dataclass
class Trace:
    """All outputs of a head, and the values that its driver read."""

    line: list[tuple[bool, int, int]] = field(default_factory=list)
    pins: list[tuple[int, str, float]] = field(default_factory=list)
    samples: list[tuple[bytes, bytes, int]] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)


def eventful(kind: str) -> Trace:
    """Run two seconds with events of all kinds."""
    trace = Trace()
    rng = np.random.default_rng(3)
    with opened_head(kind, NoiseModel()) as h:

        def tap(to_head: bool, byte: int) -> int:
            trace.line.append((to_head, h.clock.now_ns() if to_head else 0, byte))
            return byte ^ 0x40 if rng.random() < 0.001 else byte

        def read() -> None:
            try:
                samples = h.imu.read_samples()
                trace.samples.append((samples.time_ns.tobytes(), samples.gyro_dps.tobytes(), samples.lost))
                h.imu.check()
            except RigError as error:
                trace.errors.append(str(error))

        h.head.filters.append(tap)
        h.imu.set_power(True)
        h.imu.set_light(0.3)
        h.world.drive(to_position(h.clock.now_ns() * 1e-9, 0.0, 0.0, 70.0, 90.0, 300.0))
        for step in range(40):
            if step == 8:
                h.head.nack(2)
            if step == 12:
                h.head.stuck = 5
            if step == 16:
                h.head.babble(rng.bytes(50))
                h.head.send(rng.bytes(50))
            if step == 20:
                h.head.estop_open = True
            if step == 22:
                h.head.estop_open = False
            if step == 24:
                h.imu.acknowledge()
            if step == 28:
                h.head.reset(Reset.BROWN_OUT)
            h.clock.sleep(0.05)
            read()
        trace.pins = [(c.time_ns, c.pin, c.value) for c in h.head.changes]
    return trace


@pytest.mark.parametrize("kind", KINDS)
def test_two_runs_are_identical_to_the_cycle(kind):
    first, second = eventful(kind), eventful(kind)
    assert first == second
    assert any("e-stop" in error for error in first.errors)
    assert any("restarted" in error for error in first.errors)
    assert {pin for _, pin, _ in first.pins} == {"light", "relay"}
    assert sum(len(times) // 8 for times, _, _ in first.samples) > 200


@pytest.mark.parametrize("kind", KINDS)
def test_result_does_not_depend_on_how_often_the_board_runs(kind, monkeypatch):
    seen = []
    for quantum_s in (0.0005, 0.001, 0.005):
        monkeypatch.setattr(board, "QUANTUM_S", quantum_s)
        seen.append(undisturbed(kind))
    assert seen[0] == seen[1] == seen[2]


def undisturbed(kind: str) -> list[tuple[int, int]]:
    """Return the bytes that a head sends in a second, with their times."""
    with opened_head(kind, NoiseModel(), clock_error=0.0) as h:
        h.imu.set_light(0.5)
        h.imu._cancel()  # the host only listens: its own times must not depend on who else wakes up
        coming = []
        end_ns = h.clock.now_ns() + 1_000_000_000
        h.world.drive(to_position(h.clock.now_ns() * 1e-9, 0.0, 0.0, 40.0, 90.0, 300.0))
        while h.clock.now_ns() < end_ns:
            h.clock.sleep(0.025)
            h.head.catch_up()
            coming += [*h.head._coming]
            h.head.take(end_ns)
        return coming + [(c.time_ns, round(c.value)) for c in h.head.changes]
