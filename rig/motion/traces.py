"""Traces of the last moves: what the control loop read from encoder, servo profile, load and gyro.

A `Turntable` stores them when it ends, beside the state of the bench: nothing is written while the table moves.
"""

import json
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rig.core.clock import seconds_between
from rig.core.errors import StateNotStored
from rig.devices.servo import MotionProfile, ServoState
from rig.safety.saved_state import StateStore

FILE: Final = "moves.jsonl"
KEPT: Final = 12
"""Number of moves that are kept."""
MOST: Final = 1500  # a minute of a flight; more: a slow scan fills the memory
"""Largest number of readings, and of groups of gyro samples, that are kept of a move: the last ones."""
AFTER_S: Final = 2.0
"""Time after the rest for which the gyro's samples still belong to the move."""


@dataclass(eq=False)
class MoveTrace:
    """The readings of one move, from its beginning until `AFTER_S` after its rest."""

    utc: str
    start_ns: int
    from_deg: float
    """Time and angle of its beginning."""
    bias_dps: float
    """The gyro's rate at the rest before."""
    goals: list[tuple[int, float, MotionProfile]] = field(default_factory=list)
    """Each goal with its time and its profile."""
    readings: deque[tuple[int, float, float | None, float]] = field(default_factory=lambda: deque(maxlen=MOST))
    """Time, angles of encoder and servo profile (None if the model does not report it), and load, the share of the
    torque or of the current limit."""
    samples: deque[tuple[NDArray[np.int64], NDArray[np.float64]]] = field(default_factory=lambda: deque(maxlen=MOST))
    arrived_ns: int | None = None
    """Time of the first reading after the end of the servo's profile."""
    settled_ns: int | None = None
    """Time of the rest; None if the move failed."""

    def add_reading(self, state: ServoState, encoder_deg: float, profile_deg: float | None) -> None:
        """Add a reading of the servo, with its angles as the table's."""
        self.readings.append((state.time_ns, encoder_deg, profile_deg, state.load_percent))
        if state.moving:
            self.arrived_ns = None
        elif self.arrived_ns is None:
            self.arrived_ns = state.time_ns

    def add_samples(self, time_ns: NDArray[np.int64], rate_dps: NDArray[np.float64]) -> None:
        """Add samples of the gyro about the table's axis, with its bias."""
        if time_ns.size and (self.settled_ns is None or time_ns[0] < self.settled_ns + AFTER_S * 1e9):
            self.samples.append((time_ns, rate_dps))

    def gyro(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return times and rates (°/s, without bias) of the gyro's samples, (n,)."""
        if not self.samples:
            return np.empty(0, np.int64), np.empty(0)
        times, rates = zip(*self.samples, strict=True)
        return np.concatenate(times), np.concatenate(rates) - self.bias_dps

    def as_json(self) -> dict[str, Any]:
        """Return the trace as JSON values; times are seconds since the beginning."""

        def since_s(time_ns: int | None) -> float | None:
            return None if time_ns is None else round(seconds_between(self.start_ns, time_ns), 4)

        time_ns, rate_dps = self.gyro()
        times, encoder, profile, load = zip(*self.readings, strict=True) if self.readings else ((),) * 4
        return {
            "utc": self.utc,
            "from_deg": round(self.from_deg, 3),
            "to_deg": round(self.goals[-1][1], 3) if self.goals else None,
            "arrived_s": since_s(self.arrived_ns),
            "settled_s": since_s(self.settled_ns),
            "goals": [
                [
                    since_s(at_ns),
                    round(goal_deg, 3),
                    round(profile.velocity_dps, 2),
                    round(profile.acceleration_dps2, 2),
                ]
                for at_ns, goal_deg, profile in self.goals
            ],
            "time_s": [since_s(at_ns) for at_ns in times],
            "encoder_deg": [round(angle, 3) for angle in encoder],
            "profile_deg": [None if angle is None else round(angle, 3) for angle in profile],
            "load_percent": [round(value, 1) for value in load],
            "gyro_s": ((time_ns - self.start_ns) * 1e-9).round(4).tolist(),
            "gyro_dps": rate_dps.round(3).tolist(),
        }


def store(state: StateStore, traces: deque[MoveTrace]) -> None:
    """Store moves after those that are stored already; the oldest are dropped. A full disk costs only the traces."""
    with suppress(StateNotStored):
        lines = (state.read_file(FILE) or b"").splitlines()
        lines += [json.dumps(trace.as_json(), separators=(",", ":")).encode() for trace in traces]
        state.store_file(FILE, b"\n".join(lines[-KEPT:]))


def stored(state: StateStore) -> list[dict[str, Any]]:
    """Return the stored moves as JSON values, the oldest first. Raises `StateNotStored`: they cannot be read."""
    try:
        return [json.loads(line) for line in (state.read_file(FILE) or b"").splitlines()]
    except ValueError as error:
        step = f"Delete {FILE} in the folder of the bench's state; the next move writes it again."
        raise StateNotStored(f"The stored moves are damaged: {error}.", next_step=step) from error
