"""Supervision of the table: whether it may move, and what must happen before it may move again.

    DISCONNECTED ──connect──▶ CONNECTED ──refer──▶ READY ──start──▶ MOVING ──arrive──▶ READY
                                  │                  ▲                 └──────stop───▶ STOPPED ──recheck──▶ CONNECTED
                                  └─doubt─▶ UNREFERENCED (refer)

    any state ──lose──▶ DISCONNECTED;   any state ──latch──▶ FAULT ──acknowledge──▶ CONNECTED

A state cannot be set: it changes only by an event in the table of transitions. A motion is a `with` block that can only
end by arriving, by a stop or by a latched fault. A fault outlives the process and an unplugged cable. It ends when its
cause is removed and the operator acknowledges it.

Decision: docs/decisions/0003.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from enum import Enum, StrEnum, auto
from types import MappingProxyType
from typing import Final, TypeGuard

from rig.config import RigConfig
from rig.core.clock import Clock
from rig.core.errors import (
    DeviceSilent,
    FaultLatched,
    MotionStopped,
    NotReady,
    RigError,
    StateNotStored,
    Unreferenced,
    UsageError,
)
from rig.core.next_steps import START_AGAIN, Do, NextStep, NextSteps
from rig.core.phrases import angle_range, angle_words
from rig.core.signals import uninterrupted
from rig.devices.servo import Servo, ServoCondition, ServoState
from rig.safety.angle_reference import AngleFinding, AngleReference, SavedAngleCheck, TableRecord
from rig.safety.motion_checks import find_servo_fault
from rig.safety.saved_state import (
    LatchedFault,
    MemoryStore,
    SavedSession,
    SessionEnd,
    StateStore,
    begin_session,
    end_session,
)


class TableState(StrEnum):
    """State of a bench's table."""

    DISCONNECTED = "disconnected"
    CONNECTED = "connected"
    UNREFERENCED = "unreferenced"
    READY = "ready"
    MOVING = "moving"
    STOPPED = "stopped"
    FAULT = "fault"


class StateEvent(Enum):
    """Event that takes the machine from one state to another."""

    CONNECT = auto()
    REFER = auto()
    DOUBT = auto()
    START = auto()
    ARRIVE = auto()
    STOP = auto()
    RECHECK = auto()
    LATCH = auto()
    ACKNOWLEDGE = auto()
    LOSE = auto()


_S, _E = TableState, StateEvent
_ALWAYS = {_E.LATCH: _S.FAULT, _E.LOSE: _S.DISCONNECTED}
_REFERENCE = {_E.REFER: _S.READY, _E.DOUBT: _S.UNREFERENCED}
TRANSITIONS: Mapping[TableState, Mapping[StateEvent, TableState]] = MappingProxyType(
    {
        _S.DISCONNECTED: {**_ALWAYS, _E.CONNECT: _S.CONNECTED},
        _S.CONNECTED: {**_ALWAYS, **_REFERENCE},
        _S.UNREFERENCED: {**_ALWAYS, **_REFERENCE},
        _S.READY: {**_ALWAYS, **_REFERENCE, _E.START: _S.MOVING},
        _S.MOVING: {**_ALWAYS, _E.ARRIVE: _S.READY, _E.STOP: _S.STOPPED},
        _S.STOPPED: {**_ALWAYS, _E.RECHECK: _S.CONNECTED},
        # A fault stays when the cable is unplugged and plugged in again.
        _S.FAULT: {_E.LATCH: _S.FAULT, _E.LOSE: _S.FAULT, _E.CONNECT: _S.FAULT, _E.ACKNOWLEDGE: _S.CONNECTED},
    }
)


_CHECK_CABLE: Final[NextSteps] = (
    "Look at the cable. If it hangs free,",
    Do.SET_REVOLUTIONS(revolutions=0),
    "Otherwise, give the revolutions that it is wound up. Or rotate the table by hand to its home, and",
    Do.HOME_HERE(),
)
_SET_HOME: Final[NextSteps] = ("Rotate the table by hand to its home, with the cable hanging free.", Do.HOME_HERE())
_WAYS_OUT: Final[dict[AngleFinding, NextSteps]] = {
    AngleFinding.SETTINGS_CHANGED: (*_SET_HOME, "Or restore the settings."),
    AngleFinding.BEYOND_LIMITS: (
        "Rotate the table by hand back into its limits, with the servo's supply on.",
        Do.RUN_AGAIN(),
    ),
}


class Motion:
    """A motion in progress. It counts as interrupted unless `arrived` is called."""

    def __init__(self) -> None:
        self.position_deg: float | None = None

    def arrived(self, position_deg: float) -> None:
        """Record the servo's position at which the motion came to rest."""
        self.position_deg = position_deg


class Safety:
    """State, latched fault and angle reference of one bench's table.

    The servo is only read, except by `set_goal`, and by `acknowledge` with a reboot. The state survives the process in
    ``store``; None holds it in memory.
    """

    def __init__(self, servo: Servo, config: RigConfig, clock: Clock, store: StateStore | None = None) -> None:
        self._servo = servo
        self._config = config
        self._clock = clock
        self._store: StateStore = store or MemoryStore()
        self._record = TableRecord(servo, config.table, self._store)
        self._state = TableState.DISCONNECTED if self._record.fault is None else TableState.FAULT
        self.acknowledge_checks: list[Callable[[], object]] = []
        """Called before a fault is acknowledged; each raises a `RigError` if its device has a problem."""
        self.monitors: list[Callable[[], object]] = []
        """Called in each round of the control loop; each raises a `RigError` if its device stopped the bench."""
        self.observers: list[Callable[[ServoState], object]] = []
        """Called with each reading of the servo in the control loop: for displays. They must not raise or wait."""
        self.fault_observers: list[Callable[[RigError], object]] = []
        """Hear of each fault that is latched; they must return at once."""
        self.restore_actions: list[Callable[[], object]] = []
        """Called first when a fault is acknowledged: each switches on again what its device switched off."""

    # -- status -------------------------------------------------------------------------------------------------------

    @property
    def state(self) -> TableState:
        return self._state

    @property
    def angle_reference(self) -> AngleReference:
        return self._record.angle_reference

    @property
    def fault(self) -> LatchedFault | None:
        """The latched fault, possibly of an earlier program."""
        return self._record.fault

    @property
    def doubt(self) -> SavedAngleCheck | None:
        """The reason why the table is `TableState.UNREFERENCED`; None if it is not."""
        return self._record.doubt

    @property
    def next_step(self) -> NextSteps:
        """What is to be done before the table may move; empty without a fault and a doubt."""
        return self._not_ready().steps if self.state in (TableState.FAULT, TableState.UNREFERENCED) else ()

    @property
    def findings(self) -> tuple[str, ...]:
        """The servo's condition when it was connected, for the operator."""
        return tuple(self._record.findings)

    # -- events -------------------------------------------------------------------------------------------------------

    def connect(self) -> TableState:
        """Read the condition of the servo, and check the table's angle; nothing moves.

        Raises `DeviceSilent`: the servo does not answer.
        """
        self._store.listen()  # before anything else: from now on a stop must be heard
        # What the last program left: it may have been killed, with the torque on.
        condition = self._servo.read_condition()
        findings = [f"the bench's stored state is lost: {self._record.damage}"] if self._record.damage else []
        if condition.torque:
            findings.append("the servo's torque was on: the last program could not switch it off")
        if watchdog := _watchdog_finding(condition, begin_session(self._store, self._clock)):
            findings.append(watchdog)
        if condition.hardware_errors:
            findings.append(f"the servo reports: {', '.join(condition.hardware_errors)}")
        self._record.findings = findings
        self._apply(StateEvent.CONNECT)
        self._check_angle()
        return self.state

    def prepare(self) -> None:
        """Make sure that the table may move now; call it before the torque is switched on.

        Raises `FaultLatched`: a fault waits to be acknowledged. `Unreferenced`: it is not known how far the cable is
        wound up. `DeviceFault`, `Overheated`, `SupplyOutOfRange`: the servo must not work in its condition; the fault
        is latched. `MotionStopped`: the operator requested a stop. `DeviceMismatch`, `DeviceSilent`: after a lost
        connection, another servo answers, or none.
        """
        # A request from while the torque was off is carried out: it ends what would move now, and nothing after it.
        if self._store.stop_requested():
            self._store.clear_stop()
            raise stopped()
        # At rest the table may have been rotated by hand, or its servo unplugged or replaced.
        if self.state in (TableState.CONNECTED, TableState.UNREFERENCED, TableState.READY):
            try:
                self._check_angle()
            except DeviceSilent:
                self._apply(StateEvent.LOSE)
        if self.state in (TableState.DISCONNECTED, TableState.STOPPED):
            self._servo.verify()
            self._apply(StateEvent.CONNECT if self.state is TableState.DISCONNECTED else StateEvent.RECHECK)
            self._check_angle()
        self.require_ready()
        state = self._servo.read_state()
        self.check_servo(state)
        self._record.save_position(state.position_deg)  # fails here, at rest, if the disk cannot be written

    def check_servo(self, state: ServoState) -> None:
        """Latch and raise a problem of the servo at rest: a hardware error, temperature, supply voltage."""
        if cause := find_servo_fault(state, self._config.safety, self._servo.limits):
            self.latch(cause)
            raise cause

    def require_ready(self) -> None:
        """Raise `FaultLatched`, `Unreferenced` or another `NotReady` unless the table may move.

        If a device that monitors the bench stopped it in the meantime, that fault is latched and raised.
        """
        if self.state is not TableState.READY:
            raise self._not_ready()
        self._run_monitors()

    @contextmanager
    def motion(self, ends_deg: tuple[float, ...], stop: Callable[[], bool]) -> Iterator[Motion]:
        """Hold the state `TableState.MOVING` for a ``with`` block, on a path between the table angles ``ends_deg``.

        If the block is interrupted, ``stop`` is called. It stops the table and returns whether the servo received the
        stop. The state is then STOPPED or DISCONNECTED, or a FAULT is latched. The path is on the disk before anything
        moves.

        Raises `NotReady`: the table may not move in this state. `MotionStopped`: the operator requested a stop before
        this motion, for example while the plan paused; nothing moved. `StateNotStored`: the path cannot be stored;
        nothing moved.
        """
        # Before: the path is on the disk, so that the next program knows where the servo may be if this one is killed.
        self.require_ready()
        self.check_stop_request()
        motion = Motion()
        path = [self.angle_reference.to_servo(angle) for angle in ends_deg]
        self._record.save_position(path_deg=(min(path), max(path)))
        try:
            self._apply(StateEvent.START)
            yield motion
            if motion.position_deg is None:
                raise MotionStopped("The motion was interrupted.", next_step="Start it again.")
            self._apply(StateEvent.ARRIVE)
        except BaseException as symptom:
            # Ended early, by anything, also Ctrl+C: stop first, then latch or remember why the angle is not known.
            with uninterrupted():
                error = self._find_monitor_fault(symptom)  # the e-stop, and not the silence that follows from it
                received = False
                try:
                    received = stop()
                    if not received:
                        error.add_note(
                            "The servo did not receive the stop: its watchdog stops the table, its torque stays on."
                        )
                finally:  # also if the stop itself failed
                    if isinstance(error, RigError) and error.latches:
                        self.latch(error)
                    elif self.state is TableState.MOVING:
                        self._apply(StateEvent.STOP if received else StateEvent.LOSE)
            if error is not symptom:
                raise error from symptom
            raise
        self._record.save_position(motion.position_deg)  # at rest again: the path is no longer open

    def beyond_limits(self, table_deg: float) -> bool:
        """Return whether the table may not rest at an angle, because it exceeds the cable budget."""
        return self._record.beyond_limits(table_deg)

    def set_goal(self, position_deg: float) -> None:
        """Give the servo a goal, moved into the table's limits. Nothing else in the program writes a goal."""
        # The last guard of the cable: plans are checked before, but a goal must not depend on that.
        ends_deg = [self.angle_reference.to_servo(limit) for limit in self._config.table.limits_deg]
        self._servo.move_to(min(max(position_deg, min(ends_deg)), max(ends_deg)))

    def check_stop_request(self) -> None:
        """Raise `MotionStopped` if the operator requested a stop, or the fault of a device that stopped the bench.

        Called in each round of the control loop.
        """
        if self._store.stop_requested():
            raise stopped()
        self._run_monitors()

    def end_session(self, ended: SessionEnd) -> None:
        """Store how this program ends its session, so that the next one knows that it did not crash."""
        end_session(self._store, ended)
        self._store.stop_listening()

    def released(self) -> None:
        """Store the angle at which the table rests without torque, and clear a request to stop."""
        with suppress(DeviceSilent, StateNotStored):  # the state stored before the motion stays valid
            if self._record.check_angle():
                self._record.save_position()
        self._store.clear_stop()

    def latch(self, error: RigError) -> None:
        """Latch a fault: nothing moves until it is acknowledged. An earlier fault stays."""
        self._apply(StateEvent.LATCH)  # first: it holds in this program whatever happens to the disk
        self._add_acknowledgement(error)
        if self.fault is None:  # the first fault is the cause, later ones often follow from it
            try:
                self._record.save_fault(LatchedFault.of(error, self._clock.utc().isoformat(timespec="seconds")))
            except StateNotStored as not_stored:
                self._add_acknowledgement(error, is_stored=False)
                error.add_note(f"The fault is latched in this program only. {not_stored.what}")
            for tell in self.fault_observers:
                tell(error)

    def _add_acknowledgement(self, error: RigError, *, is_stored: bool = True) -> None:
        """Add to the next step of a fault that it is acknowledged at the end, unless the error says when."""
        kinds = (Do.ACKNOWLEDGE, Do.ACKNOWLEDGE_IN_PROGRAM)
        kind = kinds[0] if is_stored and self._store.outlasts_program else kinds[1]

        def is_acknowledgement(step: str | NextStep) -> TypeGuard[NextStep]:
            return isinstance(step, NextStep) and step.action in kinds

        steps = error.steps if any(map(is_acknowledgement, error.steps)) else (*error.steps, kind())
        error.steps = tuple(replace(step, action=kind) if is_acknowledgement(step) else step for step in steps)

    def acknowledge(self, *, reboot: bool = False) -> TableState:
        """Acknowledge the latched fault after its cause is gone: servo, settings, supply and angle are checked.

        Problems that do not show at rest (a jam, a loose platter) show in the next motion. With ``reboot`` the servo
        restarts first: nothing else clears its hardware errors. The new state is READY, or UNREFERENCED if the table's
        angle is uncertain.

        Raises `DeviceFault`, `Overheated`, `SupplyOutOfRange`, `DeviceMismatch`, `DeviceSilent`: the cause is still
        there; the fault stays.
        """
        # First the supply: without it the servo could not answer.
        for restore in self.restore_actions:
            restore()
        if self.state in (TableState.DISCONNECTED, TableState.STOPPED):
            self.prepare()
        if reboot:
            if self._record.check_angle():  # the servo forgets its revolutions, the stored angle gives them back
                self._record.save_position()
            self._servo.reboot()
        else:
            self._servo.verify()
        # The causes that show at rest must be gone.
        if cause := find_servo_fault(self._servo.read_state(), self._config.safety, self._servo.limits, again=True):
            self._add_acknowledgement(cause)
            raise cause
        for check in self.acknowledge_checks:
            check()
        # On the disk first: a fault that could not be removed there must not be forgotten here.
        if self.state is TableState.FAULT:
            self._record.save_fault(None)
            self._apply(StateEvent.ACKNOWLEDGE)
        self._check_angle()
        return self.state

    def set_angle(self, table_deg: float) -> None:
        """Set the table's present angle to ``table_deg``, after the operator looked at the cable.

        Raises `NotReady`: the servo is not connected, or a fault is latched. `UsageError`: the angle is beyond the
        table's limits; nothing is stored.
        """
        if self._record.beyond_limits(table_deg):
            raise UsageError(
                f"The table cannot be at {angle_words(table_deg)}: its cable budget is "
                f"{angle_range(self._config.table.limits_deg)}.",
                next_step=("Check the revolutions that you gave.", *_SET_HOME),
            )
        if StateEvent.REFER not in TRANSITIONS[self._state]:
            raise self._not_ready()
        self._record.set_angle(table_deg)
        self._apply(StateEvent.REFER)

    def set_revolutions(self, revolutions: int) -> None:
        """Set the number of revolutions by which the cable is wound up, as the operator sees it; home does not change.

        Raises `NotReady`: as in `set_angle`; or a gear hides the table's angle within its revolution from the servo; or
        the settings of the table were changed. `UsageError`: as in `set_angle`.
        """
        if self.doubt and self.doubt.finding is AngleFinding.SETTINGS_CHANGED:
            raise self._not_ready()
        if self.doubt and self._servo.revolution_deg < 360.0:
            raise NotReady(
                "Because of its gear, the servo cannot measure the table's angle within a revolution.",
                next_step=_SET_HOME,
            )
        self.set_angle(self.angle_reference.with_revolutions(self._servo.read_state().position_deg, revolutions))

    def _run_monitors(self) -> None:
        """Raise the fault of a device that stopped the bench, and latch it."""
        for monitor in self.monitors:
            try:
                monitor()
            except RigError as fault:
                if fault.latches and self.state is not TableState.MOVING:  # `motion` latches the faults of a motion
                    self.latch(fault)
                raise

    def _find_monitor_fault(self, symptom: BaseException) -> BaseException:
        """Return the fault of a device that stopped the bench, else ``symptom``."""
        if isinstance(symptom, RigError) and not symptom.latches:
            for monitor in self.monitors:
                try:
                    monitor()
                except RigError as cause:
                    if cause.latches:
                        return cause
        return symptom

    def _apply(self, event: StateEvent) -> None:
        if event not in TRANSITIONS[self._state]:
            raise self._not_ready()
        self._state = TRANSITIONS[self._state][event]

    def _check_angle(self) -> None:
        """Check the table's angle and change the state accordingly; a fault stays."""
        certain = self._record.check_angle()
        if self.state is not TableState.FAULT:
            self._apply(StateEvent.REFER if certain else StateEvent.DOUBT)

    def _not_ready(self) -> NotReady:
        """Return the error with the reason why nothing may move, and the next step."""
        if self.fault is not None:
            fault = self.fault
            return FaultLatched(
                f"A fault is latched since {fault.utc}: {fault.detail}",
                next_step=fault.steps,
                evidence={"code": fault.code, **fault.evidence},
            )
        match self.state:
            case TableState.UNREFERENCED:
                return Unreferenced(
                    f"How far the table's cable is wound up is not known: {self.doubt}.",
                    next_step=_WAYS_OUT.get(self.doubt.finding, _CHECK_CABLE) if self.doubt else _CHECK_CABLE,
                    evidence={"finding": self.doubt.finding} if self.doubt else None,
                )
            case TableState.STOPPED:
                return NotReady(
                    "The last motion was interrupted: the table's angle is not known.",
                    next_step="Find the cause, then leave the with block and enter it again.",
                )
            case _:
                return NotReady(
                    f"The table is {self.state}.", next_step="Open the bench, and move it in `with Turntable(bench):`."
                )


def _watchdog_finding(condition: ServoCondition, last: SavedSession | None) -> str:
    """Return what the servo's watchdog shows about the last session; empty if that ended in an orderly way."""
    if not (condition.watchdog_tripped or condition.watchdog_armed):
        return ""
    if last is not None and last.ended is not None:
        was_pulled = condition.watchdog_tripped and last.ended in (SessionEnd.FINISHED, SessionEnd.FAILED)
        return "the servo's watchdog stopped it: the cable was unplugged, or the computer paused" * was_pulled
    program = f"the last program (`{last.command}`, since {last.since_utc})" if last else "the last program"
    if condition.watchdog_tripped:
        return f"the servo's watchdog stopped it: {program} was killed{'' if last else ', or the cable was unplugged'}"
    return f"the servo's watchdog was still armed: {program} was killed during a motion"


def stopped() -> MotionStopped:
    """Return the error of a motion that the operator stopped."""
    return MotionStopped(
        "The operator stopped the table; its torque is off.",
        next_step=("When the table may move,", *START_AGAIN),
    )
