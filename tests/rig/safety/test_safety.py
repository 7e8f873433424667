"""The state machine: after any events in any order, READY means that the cable's revolutions are right."""

from contextlib import ExitStack, suppress

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from hbr.core.angles import wrap180
from rig.config import RigConfig
from rig.core.errors import (
    DeviceFault,
    DeviceMismatch,
    DeviceSilent,
    FaultLatched,
    MotionStopped,
    NotReady,
    Overheated,
    RigError,
    Stalled,
    StateNotStored,
    Unreferenced,
    UsageError,
)
from rig.core.next_steps import Do
from rig.devices.servo import ServoCondition, ServoIdentity, ServoLimits, ServoState
from rig.safety.angle_reference import AngleFinding
from rig.safety.saved_state import BenchState, FileStore, LatchedFault, MemoryStore, StateStore
from rig.safety.supervisor import TRANSITIONS, Safety, StateEvent, TableState
from sim.clock import VirtualClock
from tests.fuzzing import fuzz_settings


class Shaft:
    """A servo as far as the safety layer sees it, and the truth about the cable.

    It can be read, verified and restarted. If the safety layer wrote anything else to it, an AttributeError would
    result.
    """

    identity = ServoIdentity("xl430_w250", 1060, 1, 46)
    limits = ServoLimits(72.0, (6.0, 14.0))
    revolution_deg = 360.0

    def __init__(self) -> None:
        self.cable_deg = 0.0
        self.count_deg = 180.0  # what the servo reads at cable angle 0
        self.set_up = False
        self.there = True
        self.other = False
        self.errors: tuple[str, ...] = ()

    def power_cycle(self) -> None:
        read_deg = self.cable_deg + self.count_deg
        self.count_deg += read_deg % 360.0 - read_deg
        self.set_up = False

    def read_state(self) -> ServoState:
        self._answer()
        position_deg = self.cable_deg + self.count_deg
        return ServoState(0, position_deg, 0.0, 0.0, 12.0, 30.0, False, True, self.errors)

    def read_condition(self) -> ServoCondition:
        self._answer()
        return ServoCondition(False, False, False, not self.set_up, self.errors)

    def verify(self) -> None:
        self._answer()
        if self.other:
            raise DeviceMismatch("Another servo answers.", next_step="Connect the right one.")

    def reboot(self) -> None:
        self.verify()
        self.power_cycle()
        self.errors = ()

    def _answer(self) -> None:
        if not self.there:
            raise DeviceSilent("The servo does not answer.", next_step="Check its cable.")


ENDS = {
    "arrives": None,
    "stalls": Stalled("The table is blocked.", next_step="Free it."),
    "is stopped": MotionStopped("Stopped.", next_step="Start again."),
    "is interrupted": KeyboardInterrupt(),
    "hits a bug": ZeroDivisionError(),
}


class Bench(RuleBasedStateMachine):
    """A bench with its technician, its cable, and all events."""

    def __init__(self) -> None:
        super().__init__()
        self.shaft = Shaft()
        self.store = MemoryStore()
        self.safety = self.process()
        self.connected = False
        self.zombies: list[object] = []
        self.latched = 0
        self.everything_is_fixed()

    def process(self) -> Safety:
        return Safety(self.shaft, RigConfig(), VirtualClock(), self.store)

    def check_ready_angle(self) -> None:
        """Check that the revolutions are right if the table is READY."""
        if self.safety.state is TableState.READY:
            reported_deg = self.safety.angle_reference.to_table(self.shaft.read_state().position_deg)
            assert reported_deg == pytest.approx(self.shaft.cable_deg, abs=1e-6)
            assert abs(reported_deg) <= 402.0

    # -- programs -----------------------------------------------------------------------------------------------------

    @rule()
    def a_program_starts(self) -> None:
        self.safety, self.connected = self.process(), False
        if self.shaft.there and not self.shaft.other:
            self.safety.connect()
            self.connected = True
            self.check_ready_angle()

    @precondition(lambda self: self.connected)
    @rule(
        to_deg=st.floats(-400, 400) | st.sampled_from([-400.0, -200.0, 200.0, 400.0]),
        share=st.floats(0, 1),
        end=st.sampled_from([*ENDS, "cable pulled", "killed", "supply lost"]),
    )
    def a_move(self, to_deg: float, share: float, end: str) -> None:
        safety, shaft = self.safety, self.shaft
        with suppress(DeviceFault, FaultLatched, Unreferenced, DeviceSilent, DeviceMismatch):
            safety.prepare()
        if safety.state is not TableState.READY:
            with pytest.raises(NotReady), safety.motion((0.0, to_deg), lambda: True):
                pytest.fail("it moves")
            return
        if not shaft.there:
            return
        self.check_ready_angle()
        shaft.set_up = True
        start_deg = shaft.cable_deg
        motion = safety.motion((start_deg, to_deg), lambda: shaft.there)
        with suppress(KeyboardInterrupt, ZeroDivisionError, RigError):
            with ExitStack() as block:
                begun = block.enter_context(motion)
                assert safety.state is TableState.MOVING
                with pytest.raises(NotReady):
                    safety.require_ready()
                shaft.cable_deg = start_deg + (to_deg - start_deg) * (1.0 if end == "arrives" else share)
                if end == "killed":  # a killed program runs none of its exits
                    self.zombies.append(block.pop_all())
                    self.safety, self.connected = self.process(), False
                    return
                self.what_ends_it(end)
                begun.arrived(shaft.read_state().position_deg)
            assert end == "arrives"
        error = ENDS.get(end)
        if error is None and end == "arrives":
            assert safety.state is TableState.READY
        elif (isinstance(error, RigError) and error.latches) or end == "supply lost":
            assert safety.state is TableState.FAULT
        else:
            assert safety.state is (TableState.STOPPED if shaft.there else TableState.DISCONNECTED)
        safety.released()

    def what_ends_it(self, end: str) -> None:
        if end == "supply lost":
            self.shaft.power_cycle()
            raise DeviceFault("The servo restarted.", next_step="Check the supply.")
        if end == "cable pulled":
            self.shaft.there = False
            self.shaft.read_state()
        if error := ENDS[end]:
            raise error

    @precondition(lambda self: self.connected)
    @rule(reboot=st.booleans())
    def acknowledged(self, reboot: bool) -> None:
        fault, errors = self.safety.fault, self.shaft.errors
        well = self.shaft.there and not self.shaft.other and (reboot or not errors)
        with suppress(RigError):
            self.safety.acknowledge(reboot=reboot)
            assert well
            assert self.safety.fault is None
            assert self.safety.state in (TableState.READY, TableState.UNREFERENCED)
            return
        assert fault is None or self.safety.fault == fault
        assert not well or fault is None

    @precondition(lambda self: self.connected)
    @rule()
    def a_plan_finds_something_wrong(self) -> None:
        self.safety.latch(Stalled(f"Fault {self.latched}.", next_step="Look."))
        self.latched += 1
        assert self.safety.state is TableState.FAULT

    @rule()
    def everything_is_fixed(self) -> None:
        """Fix everything, as a technician does in the morning; without this, most runs would stay in the first
        fault."""
        self.shaft.there, self.shaft.other, self.shaft.errors = True, False, ()
        self.a_program_starts()
        if self.safety.fault:
            self.acknowledged(reboot=False)
        if self.safety.doubt:
            self.operator_checks_the_cable(zero_here=False)

    # -- people -------------------------------------------------------------------------------------------------------

    @precondition(lambda self: self.connected and self.shaft.there and not self.shaft.other)
    @rule(zero_here=st.booleans())
    def operator_checks_the_cable(self, zero_here: bool) -> None:
        wound_deg = self.shaft.cable_deg
        if abs(wound_deg) > 400.0:  # beyond the limits, the operator unwinds the cable by hand
            self.shaft.cable_deg = float(wrap180(wound_deg))
        with suppress(NotReady):
            if zero_here:
                self.safety.set_angle(0.0)
                self.shaft.count_deg += self.shaft.cable_deg
                self.shaft.cable_deg = 0.0
            elif self.safety.doubt and self.safety.doubt.finding is not AngleFinding.NEVER_REFERENCED:
                within_deg = float(wrap180(self.shaft.cable_deg))
                self.safety.set_revolutions(round((self.shaft.cable_deg - within_deg) / 360.0))
            else:
                self.safety.set_angle(self.shaft.cable_deg)
            assert self.safety.state is TableState.READY
            return
        assert self.safety.state in (TableState.FAULT, TableState.STOPPED, TableState.DISCONNECTED)
        self.shaft.cable_deg = wound_deg  # a whole revolution that is not reported cannot be detected (see below)

    @rule(by_deg=st.floats(-720, 720) | st.sampled_from([-360.0, -180.0, 0.0, 180.0, 360.0]))
    def the_table_is_rotated_by_hand(self, by_deg: float) -> None:
        """Rotate by almost whole revolutions, with the supply off: no encoder can detect this."""
        table = self.store.state.table
        written_deg = table.position_deg + table.shift_deg - 180.0 if table else 0.0
        rotated_deg = self.shaft.cable_deg + by_deg - written_deg
        if abs(rotated_deg) < 180 or abs(wrap180(rotated_deg)) > 2.1:
            self.shaft.cable_deg += by_deg

    # -- devices ------------------------------------------------------------------------------------------------------

    @rule()
    def the_supply_goes_and_comes_back(self) -> None:
        self.shaft.power_cycle()

    @rule(
        there=st.sampled_from([True, True, False]),
        other=st.sampled_from([False, False, True]),
        errors=st.sampled_from([(), (), ("overload",)]),
    )
    def a_device_fails_or_is_well_again(self, there: bool, other: bool, errors: tuple[str, ...]) -> None:
        self.shaft.there, self.shaft.other, self.shaft.errors = there, other, errors

    # -- invariants ---------------------------------------------------------------------------------------------------

    @invariant()
    def a_fault_outlives_its_program(self) -> None:
        if self.safety.fault:
            assert self.safety.state is TableState.FAULT
            again = self.process()
            assert again.state is TableState.FAULT
            assert again.fault == self.safety.fault
            with pytest.raises(FaultLatched, match=self.safety.fault.detail):
                again.require_ready()


TestBench = Bench.TestCase
TestBench.settings = settings(fuzz_settings(0.2), stateful_step_count=30)


def test_only_an_acknowledgement_clears_a_fault():
    leaving = [(s, h, to) for s, ways in TRANSITIONS.items() for h, to in ways.items() if s is not to]
    assert {h for s, h, _ in leaving if s is TableState.FAULT} == {StateEvent.ACKNOWLEDGE}
    assert {(s, h) for s, h, to in leaving if to is TableState.MOVING} == {(TableState.READY, StateEvent.START)}
    assert all(ways[StateEvent.LATCH] is TableState.FAULT for ways in TRANSITIONS.values())
    assert {s for s, h, to in leaving if to is TableState.READY} == {
        TableState.CONNECTED,
        TableState.UNREFERENCED,
        TableState.MOVING,
    }
    with pytest.raises(TypeError):
        TRANSITIONS[TableState.FAULT] = {}
    with pytest.raises(AttributeError):
        Safety(Shaft(), RigConfig(), VirtualClock()).state = TableState.READY


def test_nothing_moves_if_the_state_cannot_be_stored():
    class Full(MemoryStore):
        full = False

        def save(self, state: BenchState) -> None:
            if self.full:
                raise StateNotStored("The disk is full.", next_step="Make room.")
            super().save(state)

        def latch(self, fault: LatchedFault | None) -> None:
            if self.full:
                raise StateNotStored("The disk is full.", next_step="Make room.")
            super().latch(fault)

    store = Full()
    safety = Safety(Shaft(), RigConfig(), VirtualClock(), store)
    safety.connect()
    safety.set_angle(0.0)
    store.full = True
    with pytest.raises(StateNotStored), safety.motion((0.0, 90.0), lambda: True):
        pytest.fail("it moves")
    assert safety.state is TableState.READY
    stalled = Stalled("Blocked.", next_step="Free it.")
    safety.latch(stalled)  # the fault is latched even if the disk is full
    assert safety.state is TableState.FAULT
    assert "in this program only" in stalled.__notes__[0]
    assert stalled.steps == ("Free it.", Do.ACKNOWLEDGE_IN_PROGRAM())


def test_a_fault_is_acknowledged_by_a_command_only_if_its_latch_outlasts_the_program(tmp_path):
    def latched(store: StateStore) -> str:
        error = Overheated("It is hot.", next_step=("Wait.", Do.ACKNOWLEDGE(reboot=True), Do.RUN_AGAIN()))
        safety = Safety(Shaft(), RigConfig(), VirtualClock(), store)
        safety.latch(error)
        with pytest.raises(FaultLatched) as rejected:
            safety.require_ready()
        assert rejected.value.steps == error.steps == safety.next_step
        return error.next_step

    assert latched(FileStore(tmp_path)) == (
        "Wait. Then acknowledge the fault: `rig acknowledge --reboot`. Then start again."
    )
    in_memory = latched(MemoryStore())
    assert in_memory.startswith("Wait. Then start the program again: ")
    assert "rig acknowledge" not in in_memory


def test_motion_without_arrival_counts_as_interrupted():
    safety = Safety(Shaft(), RigConfig(), VirtualClock())
    safety.connect()
    safety.set_angle(0.0)
    stops = []
    with pytest.raises(MotionStopped), safety.motion((0.0, 90.0), lambda: bool(stops.append(1)) or True):
        pass
    assert stops == [1]
    assert safety.state is TableState.STOPPED


def test_evidence_without_json_type_is_stored_as_text():
    safety = Safety(Shaft(), RigConfig(), VirtualClock())
    safety.latch(Stalled("Blocked.", next_step="Free it.", evidence={"seen": {1, 2}, "at": 3.5, "rate": float("nan")}))
    assert safety.fault.evidence["at"] == 3.5
    assert isinstance(safety.fault.evidence["seen"], str)
    assert BenchState.model_validate_json(BenchState(fault=safety.fault).model_dump_json()).fault.code == 505


def test_first_fault_stays_until_an_acknowledgement_has_checked_all_devices():
    safety = Safety(Shaft(), RigConfig(), VirtualClock())
    safety.connect()
    safety.latch(Stalled("Blocked.", next_step="Free it."))
    safety.latch(Stalled("The second.", next_step="Free it."))
    assert safety.fault.detail == "Blocked."

    def gyro() -> None:
        raise UsageError("the gyro is not well", next_step="look at it")

    safety.acknowledge_checks.append(gyro)
    with pytest.raises(UsageError):
        safety.acknowledge()
    assert safety.state is TableState.FAULT
    safety.acknowledge_checks.clear()
    assert safety.acknowledge() is TableState.UNREFERENCED
