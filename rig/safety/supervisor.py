"""Whether the table may move, and what must happen before it may move again.

The states and their transitions are those of `rig.safety.state_machine`. A motion is a `with` block, which cannot be
left without arriving, a stop or a latched fault. A fault outlives the process, and a pulled cable; it ends when its
cause is gone and a person acknowledges it.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from rig.config import RigConfig
from rig.core.clock import Clock
from rig.core.errors import (
    DeviceFault,
    DeviceSilent,
    EmergencyStop,
    FaultLatched,
    FollowingError,
    HeadRestarted,
    HeartbeatLost,
    MotionStopped,
    MotionTimeout,
    NoProgress,
    NotReady,
    Overheated,
    Overloaded,
    RigError,
    RotationDisagreement,
    Stalled,
    StateNotStored,
    SupplyOutOfRange,
    Unreferenced,
)
from rig.devices.servo import Servo, ServoState
from rig.safety.angle_reference import AngleReference, check_saved_angle
from rig.safety.motion_checks import find_servo_fault
from rig.safety.saved_state import BenchState, LatchedFault, MemoryStore, SavedTable, StateStore
from rig.safety.state_machine import StateEvent, StateMachine
from rig.safety.state_machine import TableState as TableState

LATCHING = (
    DeviceFault,
    MotionTimeout,
    RotationDisagreement,
    FollowingError,
    Stalled,
    Overloaded,
    Overheated,
    SupplyOutOfRange,
    NoProgress,
    EmergencyStop,
    HeartbeatLost,
    HeadRestarted,
)
"""Errors that, when they end a motion, leave a fault: something is wrong with the bench and a person must look."""


class Motion:
    """A motion in progress; one that was not said to have `arrived` counts as broken off."""

    def __init__(self) -> None:
        self.position_deg: float | None = None

    def arrived(self, position_deg: float) -> None:
        """Say where, by the servo's own count, the motion came to rest."""
        self.position_deg = position_deg


class Safety:
    """TableState, latched fault and reference of one bench's table.

    Parameters
    ----------
    servo
        Asked for its condition; nothing is written to it but on `acknowledge` with a reboot.
    config
        Of the bench.
    clock
        For the dates of faults.
    store
        Where the state outlives the process; None keeps it in memory.
    """

    def __init__(self, servo: Servo, config: RigConfig, clock: Clock, store: StateStore | None = None) -> None:
        self._servo = servo
        self._config = config
        self._clock = clock
        self._store: StateStore = store or MemoryStore()
        self._kept = self._store.load()
        self._machine = StateMachine(faulty=self._kept.fault is not None)
        self._doubt = ""
        self._findings: list[str] = []
        self.angle_reference = AngleReference(
            config.table, self._kept.table.shift_deg if self._kept.table else 0.0, servo.turn_deg
        )
        self.acknowledge_checks: list[Callable[[], object]] = []
        """Called before a fault is acknowledged; each raises a `RigError` where its device is not well."""
        self.monitors: list[Callable[[], object]] = []
        """Called in every round of the control loop; each raises a `RigError` where its device has made us stop."""
        self.restore_actions: list[Callable[[], object]] = []
        """Called first of all when a fault is acknowledged: give back what a device has switched off."""

    # -- what is ------------------------------------------------------------------------------------------------------

    @property
    def state(self) -> TableState:
        return self._machine.state

    @property
    def fault(self) -> LatchedFault | None:
        """The latched fault, perhaps of a program that ended long ago."""
        return self._kept.fault

    @property
    def doubt(self) -> str:
        """Why the table is `TableState.UNREFERENCED`; empty where it is not."""
        return self._doubt

    @property
    def findings(self) -> tuple[str, ...]:
        """In what condition the servo was found when it was connected, for the operator."""
        return tuple(self._findings)

    # -- what happens -------------------------------------------------------------------------------------------------

    def connect(self) -> TableState:
        """Look at the servo that was opened, and judge where the table stands; nothing moves.

        Raises
        ------
        DeviceSilent
            The servo does not answer.
        """
        condition = self._servo.read_condition()
        self._findings = [f"the bench's state is lost: {self._kept.damage}"] if self._kept.damage else []
        if condition.torque:
            self._findings.append("the servo's torque was on: the last program had no chance to switch it off")
        if condition.watchdog_tripped:
            self._findings.append("the servo's watchdog had stopped it: the last program died, or the cable was pulled")
        elif condition.watchdog_armed:
            self._findings.append("the servo's watchdog was still armed: the last program died while the table moved")
        if condition.hardware_errors:
            self._findings.append(f"the servo reports: {', '.join(condition.hardware_errors)}")
        self._go(StateEvent.CONNECT)
        self._judge()
        return self.state

    def prepare(self) -> None:
        """Make sure that the table may move now; before torque comes on.

        Raises
        ------
        FaultLatched
            A fault waits to be acknowledged.
        Unreferenced
            How far the cable is wound up is in doubt.
        DeviceFault, Overheated, SupplyOutOfRange
            The servo must not work as it is; latched.
        MotionStopped
            Somebody has asked for a stop.
        DeviceMismatch, DeviceSilent
            After a lost connection another servo answers, or none.
        """
        if self._store.stop_requested():
            self._store.clear_stop()
            raise _stopped()
        if self.state in (TableState.CONNECTED, TableState.UNREFERENCED, TableState.READY):
            try:
                self._judge()
            except DeviceSilent:
                self._go(StateEvent.LOSE)
        if self.state in (TableState.DISCONNECTED, TableState.STOPPED):
            self._servo.verify()
            self._go(StateEvent.CONNECT if self.state is TableState.DISCONNECTED else StateEvent.RECHECK)
            self._judge()
        self.require_ready()
        state = self._servo.read_state()
        self.check_servo(state)
        self._save(table=self._table(state.position_deg))

    def check_servo(self, state: ServoState) -> None:
        """Latch, and raise, what a reading at rest shows: a hardware error, heat, a supply out of range."""
        if cause := find_servo_fault(state, self._config.safety, self._servo.limits):
            self.latch(cause)
            raise cause

    def require_ready(self) -> None:
        """Raise `FaultLatched`, `Unreferenced` or another `NotReady` unless the table may move.

        Also what a device that guards the bench has stopped it for meanwhile; that is latched.
        """
        if self.state is not TableState.READY:
            raise self._refusal()
        self._look_around()

    @contextmanager
    def motion(self, ends_deg: tuple[float, ...], stop: Callable[[], bool]) -> Iterator[Motion]:
        """Be `TableState.MOVING` for the length of a ``with`` block, on a way between ``ends_deg`` (of the table).

        Whatever breaks the block off calls ``stop``, which stops the table and returns whether the servo heard it; then
        it is STOPPED, DISCONNECTED, or a FAULT is latched. The way is on the disk before anything moves.

        Raises
        ------
        NotReady
            The table may not move in this state.
        StateNotStored
            The way cannot be written down; nothing has moved.
        """
        self.require_ready()
        motion = Motion()
        path = [self.angle_reference.to_servo(angle) for angle in ends_deg]
        self._save(table=self._table(self._servo.read_state().position_deg, (min(path), max(path))))
        try:
            self._go(StateEvent.START)
            yield motion
            if motion.position_deg is None:
                raise MotionStopped("The motion was broken off.", next_step="Start it anew.")
            self._go(StateEvent.ARRIVE)
        except BaseException as symptom:
            error = self._guarded_cause(symptom)
            heard = False
            try:
                heard = stop()
                if not heard:
                    error.add_note(
                        "The servo did not hear the stop: its watchdog stops the table, its torque stays on."
                    )
            finally:
                if isinstance(error, LATCHING):
                    self.latch(error)
                elif self.state is TableState.MOVING:
                    self._go(StateEvent.STOP if heard else StateEvent.LOSE)
            if error is not symptom:
                raise error from symptom
            raise
        self._save(table=self._table(motion.position_deg))

    def check_stop_request(self) -> None:
        """Raise `MotionStopped` if somebody asked for a stop, or what a device that guards the bench has stopped for.

        Called in every round of the control loop.
        """
        if self._store.stop_requested():
            raise _stopped()
        self._look_around()

    def released(self) -> None:
        """Take note that the torque is off: where the table rests is kept, and a stop that was asked for is done."""
        with suppress(DeviceSilent, StateNotStored):  # what was written before the motion stays true
            if self._judged():
                self._save(table=self._table(self._servo.read_state().position_deg))
        self._store.clear_stop()

    def latch(self, error: RigError) -> None:
        """Latch a fault: nothing moves until it is acknowledged. The first one stays until then."""
        self._go(StateEvent.LATCH)
        if "rig acknowledge" not in error.next_step:
            error.next_step += " Then `rig acknowledge`."
        if self._kept.fault is None:
            fault = LatchedFault.of(error, self._clock.utc().isoformat(timespec="seconds"))
            try:
                self._save(fault=fault)
            except StateNotStored as unkept:
                self._kept = self._kept.model_copy(update={"fault": fault})
                error.add_note(f"The fault is latched in this program alone. {unkept.what}")

    def acknowledge(self, *, reboot: bool = False) -> TableState:
        """Acknowledge the latched fault after its cause is gone: servo, settings, supply and angle are verified.

        What cannot be seen in a table at rest (a jam, a loose platter) shows in the next motion.

        Parameters
        ----------
        reboot
            Restart the servo first: nothing else clears its hardware errors.

        Returns
        -------
        TableState
            READY, or UNREFERENCED where the turns are in doubt.

        Raises
        ------
        DeviceFault, Overheated, SupplyOutOfRange, DeviceMismatch, DeviceSilent
            The cause is still there; the fault stays.
        """
        for restore in self.restore_actions:
            restore()
        if self.state in (TableState.DISCONNECTED, TableState.STOPPED):
            self.prepare()
        if reboot:
            if self._judged():
                self._save(table=self._table(self._servo.read_state().position_deg))
            self._servo.reboot()
        else:
            self._servo.verify()
        if cause := find_servo_fault(self._servo.read_state(), self._config.safety, self._servo.limits, again=True):
            raise cause
        for check in self.acknowledge_checks:
            check()
        if self.state is TableState.FAULT:
            self._save(fault=None)
            self._go(StateEvent.ACKNOWLEDGE)
        self._judge()
        return self.state

    def set_angle(self, table_deg: float) -> None:
        """Take it from a person who has looked at the cable that the table now stands at ``table_deg``.

        Raises
        ------
        NotReady
            The servo is not connected, or a fault is latched.
        """
        if not self._machine.accepts(StateEvent.REFER):
            raise self._refusal()
        position_deg = self._servo.read_state().position_deg
        self.angle_reference.declare(position_deg, table_deg)
        self._save(table=self._table(position_deg))
        self._doubt = ""
        self._go(StateEvent.REFER)

    def set_revolutions(self, turns: int) -> None:
        """Take it from a person that the cable is wound up by ``turns`` whole turns; the zero stays where it was.

        Raises
        ------
        NotReady
            As of `declare`; or a gear hides from the servo where within its turn the table is.
        """
        if self._doubt and self._servo.turn_deg < 360.0:
            raise NotReady(
                "With a gear, the servo alone does not tell where within its turn the table stands.",
                next_step="Turn the table by hand to its zero, the cable hanging free, then give `rig home --here`.",
            )
        self.set_angle(self.angle_reference.with_turns(self._servo.read_state().position_deg, turns))

    # -- inside -------------------------------------------------------------------------------------------------------

    def _look_around(self) -> None:
        """Ask the devices that guard the bench; what they have stopped it for is latched."""
        for watch in self.monitors:
            try:
                watch()
            except LATCHING as fault:
                if self.state is not TableState.MOVING:  # a motion latches what breaks it off
                    self.latch(fault)
                raise

    def _guarded_cause(self, symptom: BaseException) -> BaseException:
        """Return why a device that guards the bench has stopped it, if it has: the servo then merely falls silent."""
        if isinstance(symptom, RigError) and not isinstance(symptom, LATCHING):
            for watch in self.monitors:
                try:
                    watch()
                except LATCHING as cause:
                    return cause
                except RigError:
                    continue  # it has nothing to tell: the symptom stands
        return symptom

    def _go(self, event: StateEvent) -> None:
        if not self._machine.accepts(event):
            raise self._refusal()
        self._machine.apply(event)

    def _judged(self) -> bool:
        """Compare what the servo says with what was written down; return whether the turns are beyond doubt."""
        state, condition = self._servo.read_state(), self._servo.read_condition()
        check = check_saved_angle(
            self._kept.table, self._servo.identity, state.position_deg, condition, self._servo.turn_deg
        )
        self.angle_reference.shift_deg = check.shift_deg
        self._findings += [finding for finding in check.findings if finding not in self._findings]
        self._doubt = check.doubt
        return not check.doubt

    def _judge(self) -> None:
        """Go where the comparison leads; a fault stays."""
        certain = self._judged()
        if self.state is not TableState.FAULT:
            self._go(StateEvent.REFER if certain else StateEvent.DOUBT)

    def _refusal(self) -> NotReady:
        """Return why nothing may move, and what to do."""
        if self._kept.fault is not None:
            fault = self._kept.fault
            return FaultLatched(
                f"A fault is latched since {fault.utc}: {fault.what}",
                next_step=fault.next_step,
                evidence={"code": fault.code, **fault.evidence},
            )
        match self.state:
            case TableState.UNREFERENCED:
                return Unreferenced(
                    f"How far the table's cable is wound up is in doubt: {self._doubt}.",
                    next_step="Look at the cable, then say how many whole turns it is wound up: `rig home --turns 0` "
                    "if it hangs free. Or turn the table by hand to where zero shall be: `rig home --here`.",
                )
            case TableState.STOPPED:
                return NotReady(
                    "The last motion was broken off: where the table rests is in doubt.",
                    next_step="Find the cause, then leave the with block and enter it anew.",
                )
            case _:
                return NotReady(
                    f"The table is {self.state}.", next_step="Open the bench, and move it in `with Turntable(bench):`."
                )

    def _table(self, position_deg: float, path_deg: tuple[float, float] | None = None) -> SavedTable:
        identity = self._servo.identity
        return SavedTable(
            model_number=identity.model_number,
            bus_id=identity.bus_id,
            firmware=identity.firmware,
            position_deg=position_deg,
            shift_deg=self.angle_reference.shift_deg,
            path_deg=path_deg,
        )

    def _save(self, **values: SavedTable | LatchedFault | None) -> None:
        kept: BenchState = self._kept.model_copy(update={**values, "damage": ""})
        if kept != self._kept:
            self._store.save(kept)
            self._kept = kept


def _stopped() -> MotionStopped:
    return MotionStopped(
        "The table was stopped, as `rig stop` asked for; its torque is off.",
        next_step="Give the command again when the table may move; an enrollment goes on with --resume.",
    )
