"""Stops a bench from outside: the program that holds it, or, if none does, the servo itself."""

import os
import signal
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from rig.bench import open_servo
from rig.config import RigConfig
from rig.core.clock import Clock, seconds_between
from rig.core.errors import BenchBusy, StateNotStored
from rig.safety.saved_state import FileStore, Holder, holder

HEED_S = 2.0
"""How long a program may take to see the request: many rounds of its control loop, and a long exposure."""
END_S = 5.0
"""How long it may then take to close its devices."""
POLL_S = 0.02


@dataclass(frozen=True, slots=True)
class Stop:
    """What was stopped.

    ``holder`` is the program that held the bench, ``signalled`` whether it took a signal, ``ended`` whether it is gone
    or still holds the bench, at rest; ``torque_was_on`` what the servo was found in afterwards, None where it could not
    be asked because the bench is still held.
    """

    holder: Holder | None
    signalled: bool
    ended: bool
    torque_was_on: bool | None


def stop(name: str, config: RigConfig, clock: Clock, *, seed: int | None = None) -> Stop:
    """Stop the table of the bench ``name`` and take its torque off, whoever drives it.

    Raises
    ------
    BenchBusy
        The program that holds the bench does not react.
    DeviceNotFound, DeviceMismatch, DeviceSilent
        Nobody holds it, and the servo cannot be reached.
    """
    path = config.state_path(name)
    who, signalled = holder(path), False
    if who is not None:
        store = FileStore(path)
        with suppress(StateNotStored):  # a full disk: the signal is left
            store.request_stop()
        if not store.stop_requested() or not _wait(
            clock, HEED_S, lambda: not store.stop_requested() or holder(path) is None
        ):
            # It is not in its control loop: asking for its next object, computing, or hanging.
            signalled = who.pid > 0 and _signal(who)
        if not _wait(clock, END_S, lambda: holder(path) is None) and (store.stop_requested() or signalled):
            raise _deaf(who, config)
        if holder(path) is not None:
            return Stop(who, signalled, ended=False, torque_was_on=None)
    with open_servo(name, config, seed=seed) as servo:
        torque = servo.read_condition().torque
        servo.torque_off()
    return Stop(who, signalled, ended=True, torque_was_on=torque)


def _signal(who: Holder) -> bool:
    with suppress(ProcessLookupError, PermissionError):
        # Python's own answer to SIGINT unwinds the stack; to SIGTERM it does nothing of the kind unless told to.
        os.kill(who.pid, signal.SIGTERM if who.terminates else signal.SIGINT)
        return True
    return False


def _wait(clock: Clock, seconds: float, done: Callable[[], bool]) -> bool:
    start_ns = clock.now_ns()
    while not done():
        if seconds_between(start_ns, clock.now_ns()) > seconds:
            return False
        clock.sleep(POLL_S)
    return True


def _deaf(who: Holder, config: RigConfig) -> BenchBusy:
    end_it = f"`kill -9 {who.pid}`" if who.pid else "the program, whichever it is"
    return BenchBusy(
        "The program that holds the bench does not react.",
        next_step=f"End {end_it}: a moving table then stops by its watchdog within {config.table.watchdog_s:g} s. "
        "Then `rig stop` again, for the torque.",
        evidence={"pid": who.pid, "command": who.command, "since_utc": who.since_utc},
    )
