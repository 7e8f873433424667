"""The job of `rig stop`: through the program that uses the bench or, if there is none, at the servo itself."""

import os
import signal
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass

from rig.bench import open_servo
from rig.config import RigConfig
from rig.core.clock import Clock, seconds_between
from rig.core.errors import BenchBusy, DeviceSilent, StateNotStored, TorqueStaysOn
from rig.core.next_steps import Do
from rig.safety.saved_state import SERVER_FOLDER, FileStore, Holder, LatchedFault, holder
from rig.safety.stop_channel import StopAnswer, StopRequest

REACTION_S = 2.0
"""How long a program may take to notice the request: many rounds of its control loop, and a long exposure."""
END_S = 5.0  # the operator waits for this; closing a camera alone can take seconds
"""Longest time that the program may then take to close its devices."""
POLL_S = 0.02  # shorter than a person notices


@dataclass(frozen=True, slots=True)
class StopReport:
    """Result of a stop.

    ``holder`` is the program that used the bench, ``signalled`` says whether it needed a signal, ``ended`` whether it
    ended (else it still uses the bench, at rest). ``torque_was_on`` says whether the servo's torque was on afterwards;
    None if the servo could not be asked because the bench is still in use.
    """

    holder: Holder | None
    signalled: bool
    ended: bool
    torque_was_on: bool | None


def stop(name: str, config: RigConfig, clock: Clock, *, seed: int | None = None) -> StopReport:
    """Stop the table of the bench ``name`` and switch its torque off, even if another program moves it.

    Raises `BenchBusy`: the program that uses the bench does not react. `DeviceNotFound`, `DeviceMismatch`,
    `DeviceSilent`: the servo cannot be reached, or does not answer the program that uses the bench. `TorqueStaysOn`:
    the servo does not switch its torque off; the fault is latched.
    """
    path = config.state_path(name)
    server = holder(path / SERVER_FOLDER)
    who, signalled, answer = holder(path) or server, False, None
    request = StopRequest(path)
    if request.connection is not None:
        with closing(request):
            answer = request.wait(clock, REACTION_S)
    if who is not None:
        if answer is None:  # it is not in its control loop: it waits for its next object, computes, or hangs
            signalled = who.pid > 0 and _signal(who)
        elif server is not None and answer is not StopAnswer.ENDED:  # a server stays, at rest
            if answer is StopAnswer.NOT_CONFIRMED:
                raise DeviceSilent(
                    "The server has ended its jobs, but the servo does not answer it: whether the torque is off is not "
                    "known.",
                    next_step="If the table still moves, switch off the servo's supply. Then check the servo's cable.",
                )
            return StopReport(who, signalled=False, ended=False, torque_was_on=None)
        if not _wait(clock, END_S, lambda: holder(path) is None and holder(path / SERVER_FOLDER) is None):
            if answer is None or signalled:
                raise _not_reacting(who, config)
            return StopReport(who, signalled, ended=False, torque_was_on=None)
    with open_servo(name, config, seed=seed) as servo:
        torque = servo.read_condition().torque
        try:
            servo.torque_off()
        except TorqueStaysOn as stays_on:
            with suppress(StateNotStored):
                FileStore(path).latch(LatchedFault.of(stays_on, clock.utc().isoformat(timespec="seconds")))
            raise
    return StopReport(who, signalled, ended=True, torque_was_on=torque)


def _signal(who: Holder) -> bool:
    with suppress(ProcessLookupError, PermissionError):
        # By default Python unwinds the stack on SIGINT, but not on SIGTERM.
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


def _not_reacting(who: Holder, config: RigConfig) -> BenchBusy:
    end_it = f"End it with `kill -9 {who.pid}`" if who.pid else "End that program"
    return BenchBusy(
        "The program that uses the bench does not react.",
        next_step=(
            f"{end_it}; a moving table then stops by its watchdog within {config.table.watchdog_s:g} s.",
            Do.STOP(),
        ),
        evidence={"pid": who.pid, "command": who.command, "since_utc": who.since_utc},
    )
