"""The state of the bench after an ended program: killed, without supply, without its cable, or with another servo."""

import json
from collections.abc import Generator
from contextlib import suppress

import pytest

from rig.bench import Bench
from rig.core.errors import (
    DeviceFault,
    DeviceMismatch,
    DeviceNotFound,
    DeviceSilent,
    FaultLatched,
    MotionStopped,
    MotionTimeout,
    NoProgress,
    RigError,
    Stalled,
    SupplyLost,
    Unreferenced,
    UsageError,
    WatchdogTripped,
)
from rig.core.next_steps import Do
from rig.motion.arrival import causes_found
from rig.motion.turntable import Turntable
from rig.safety.angle_reference import AngleFinding
from rig.safety.saved_state import FileStore
from rig.safety.supervisor import TableState
from sim.faults.environment import fill_disk
from sim.servo import SimServo
from tests.rig.bench_parts import BRAKED_S, Wires, at_rest, kill, program, sensor, servo_wires


@pytest.fixture
def bench_of(tmp_path):
    """Return a function that starts a program on the same bench each time; at first its cable hangs free."""
    with sensor(servo_wires()) as (wires, i2c):
        wires.i2c = i2c
        store = FileStore(tmp_path / "state")
        with program(wires, i2c, store) as bench:
            assert bench.safety.state is TableState.UNREFERENCED
            with pytest.raises(Unreferenced) as rejected, Turntable(bench):
                pass
            assert Do.SET_REVOLUTIONS(revolutions=0) in rejected.value.steps
            bench.safety.set_revolutions(0)
        yield lambda: program(wires, i2c, FileStore(tmp_path / "state")), wires


def changed(wires: Wires, tmp_path, setting: str):
    """Return a program with another setting of the table; the servo of the tests takes its gear ratio directly."""
    gear = {"gear_ratio": 1.5} if "gear" in setting else {}
    return program(wires, wires.i2c, FileStore(tmp_path / "state"), setting, **gear)


@pytest.fixture
def start(bench_of):
    return bench_of[0]


@pytest.fixture
def wires(bench_of):
    return bench_of[1]


def after(wires: Wires, seconds: float, happens) -> None:
    wires.world.clock.call_at(wires.world.clock.now_ns() + round(seconds * 1e9), happens)


def killed_in_motion(bench: Bench, wires: Wires, target_deg: float, after_s: float) -> None:
    """Start a move and have the program killed in the middle of it."""

    class Killed(BaseException):
        pass

    def die() -> None:
        raise Killed

    def moving() -> Generator[None, None, None]:
        table = Turntable(bench)
        table.__enter__()
        motion = bench.safety.motion((table.rest_deg, target_deg), lambda: True)
        motion.__enter__()
        yield
        bench.servo.arm_watchdog(bench.config.table.watchdog_s)
        bench.servo.move_to(bench.safety.angle_reference.to_servo(target_deg))
        after(wires, after_s, die)
        with suppress(Killed):
            while True:
                wires.world.clock.sleep(bench.config.table.poll_s)
                bench.servo.read_state()
        yield motion, table

    plan = moving()
    next(plan)
    next(plan)
    kill(wires, plan)


def test_servo_stops_after_sigkill_and_the_next_program_reports_it(start, wires):
    with start() as bench:
        killed_in_motion(bench, wires, 300.0, after_s=1.2)
        watchdog_s = bench.config.table.watchdog_s
    assert wires.world.shaft()[1] > 50  # it rotates on without its program
    wires.world.clock.sleep(watchdog_s + 0.15 + BRAKED_S)  # the ramp of a stop as fast as it can
    assert wires.world.shaft()[1] == 0
    assert wires.device.memory["Torque Enable"] == 1
    assert wires.device.memory["Bus Watchdog"] == 0xFF
    stands_deg = wires.world.shaft()[0]
    sent = len(wires.instructions)
    with start() as bench:
        reported = " ".join(bench.findings)
        assert "torque was on" in reported
        assert "watchdog stopped it" in reported
        assert "interrupted during a motion" in reported
        assert bench.safety.state is TableState.READY  # it kept its supply and counted its revolutions
        assert all(frame[7] != 3 for frame in wires.instructions[sent:])  # no write, so nothing moved
        with Turntable(bench) as table:
            assert wires.world.shaft()[0] == pytest.approx(stands_deg, abs=0.1)
            assert table.rest_deg == pytest.approx(stands_deg, abs=0.3)
            assert table.goto(0.0).encoder_deg == at_rest(wires.device, 0.0)
    assert wires.device.memory["Torque Enable"] == 0


def test_sigkill_and_power_cut_need_a_new_reference(start, wires):
    with start() as bench:
        killed_in_motion(bench, wires, 380.0, after_s=4.0)
    wires.world.clock.sleep(1.0)
    wires.device.power_cycle()
    wires.world.clock.sleep(1.0)
    stands_deg = wires.world.shaft()[0]
    assert stands_deg > 200  # 200° read as 20° would wind the cable up by a revolution
    with start() as bench:
        assert bench.safety.state is TableState.UNREFERENCED
        assert bench.safety.doubt.finding is AngleFinding.POWER_LOST_IN_MOTION
        with pytest.raises(Unreferenced), Turntable(bench):
            pass
        assert wires.device.memory["Torque Enable"] == 0
        bench.safety.set_revolutions(1 if stands_deg > 180 else 0)
        with Turntable(bench) as table:
            assert table.rest_deg == pytest.approx(stands_deg, abs=0.3)
            table.goto(0.0)
        assert wires.world.shaft()[0] == at_rest(wires.device, 0.0)


def test_power_cut_between_programs_loses_no_revolution(start, wires):
    with start() as bench, Turntable(bench) as table:
        table.goto(-370.0)
    wires.device.power_cycle()
    wires.world.clock.sleep(1.0)
    with start() as bench:
        assert bench.servo.read_state().position_deg == at_rest(wires.device, 170.0)
        assert "lost its supply and 1 of its revolutions" in bench.findings[0]
        with Turntable(bench) as table:
            assert table.rest_deg == at_rest(wires.device, -370.0)
            table.goto(-360.0)
        assert wires.world.shaft()[0] == at_rest(wires.device, -360.0)
    with start() as bench:  # the restored state is stored
        assert not bench.findings
        assert bench.safety.state is TableState.READY


def test_restored_revolutions_survive_a_kill_at_rest(start, wires):
    with start() as bench, Turntable(bench) as table:
        table.goto(-370.0)
    wires.device.power_cycle()
    wires.world.clock.sleep(1.0)
    with start() as bench:
        table = Turntable(bench)
        table.__enter__()  # and it is killed, with the torque on
        kill(wires)
    with start() as bench:
        assert bench.safety.state is TableState.READY
        position_deg = bench.servo.read_state().position_deg
        assert bench.safety.angle_reference.to_table(position_deg) == at_rest(wires.device, -370.0)


def test_rotation_by_hand_is_counted_with_supply_and_needs_a_new_reference_without(start, wires):
    with start() as bench, Turntable(bench) as table:
        table.goto(90.0)
    wires.world.clock.sleep(wires.device.rotate_by_hand(-30.0))
    with start() as bench:
        assert "by hand" in bench.findings[0]
        with Turntable(bench) as table:
            assert table.rest_deg == at_rest(wires.device, 60.0)
    wires.world.clock.sleep(wires.device.rotate_by_hand(-30.0))
    wires.device.power_cycle()
    wires.world.clock.sleep(1.0)
    with start() as bench, pytest.raises(Unreferenced, match="rotated while the servo had no supply"), Turntable(bench):
        pass


def test_supply_loss_in_a_motion_needs_a_new_reference(start, wires):
    with start() as bench:
        with pytest.raises((SupplyLost, DeviceSilent)), Turntable(bench) as table:
            table.goto(300.0)
            after(wires, 1.0, wires.device.power_cycle)
            table.goto(30.0)
        wires.world.clock.sleep(1.0)
        assert wires.device.memory["Torque Enable"] == 0
        with pytest.raises(Unreferenced), Turntable(bench):
            pass
    with start() as bench:
        assert bench.safety.state is TableState.UNREFERENCED


@pytest.mark.parametrize("other", [{"model": "xm430_w350"}, {"firmware": 44}])
def test_different_servo_is_rejected(other, start, wires):
    with start() as bench:
        with pytest.raises(DeviceSilent), Turntable(bench) as table:
            after(wires, 0.7, lambda: wires.bus.detach(wires.device))
            table.goto(90.0)
        wires.bus.attach(SimServo(wires.world, **other))
        with pytest.raises(DeviceMismatch), Turntable(bench):
            pass
        assert bench.safety.state is TableState.DISCONNECTED


def test_watchdog_of_a_running_program_leaves_no_fault(start, wires):
    with start() as bench:
        with pytest.raises(WatchdogTripped) as caught, Turntable(bench) as table:
            after(wires, 0.7, wires.device.trip_watchdog)
            table.goto(300.0)
        assert caught.value.exit_code == 5
        assert bench.safety.fault is None
        assert wires.device.memory["Torque Enable"] == 0
        with Turntable(bench) as table:
            assert table.goto(0.0).encoder_deg == at_rest(wires.device, 0.0)


def test_watchdog_that_was_disarmed_after_it_tripped_is_found_as_the_cause(start, wires):
    with start() as bench, Turntable(bench) as table:
        table.goto(5.0)
        bench.servo.arm_watchdog(0.1)
        bench.clock.sleep(0.3)  # the computer is busy at the end of a motion
        bench.servo.disarm_watchdog()
        with pytest.raises(WatchdogTripped), causes_found(bench.servo, bench.config.safety):
            raise MotionTimeout("The table did not come to rest.", next_step="Look for what shakes the bench.")


def test_fault_survives_the_program_until_it_is_acknowledged(start, wires):
    with start() as bench, pytest.raises(Stalled), Turntable(bench) as table:
        table.goto(10.0)
        wires.device.jam()
        table.goto(60.0)
    with start() as bench:
        assert bench.safety.state is TableState.FAULT
        with pytest.raises(FaultLatched, match="blocked") as rejected, Turntable(bench):
            pass
        assert rejected.value.evidence["code"] == Stalled.code
        assert Do.ACKNOWLEDGE() in rejected.value.steps
        wires.device.free()
        assert bench.safety.acknowledge() is TableState.READY
    with start() as bench, Turntable(bench) as table:
        assert table.goto(60.0).agrees


def test_hardware_error_needs_a_reboot_that_loses_no_revolution(start, wires):
    with start() as bench:
        with pytest.raises(DeviceFault), Turntable(bench) as table:
            after(wires, 1.5, lambda: wires.device.fail(0x20))
            table.goto(380.0)
            table.goto(0.0)
        wires.world.clock.sleep(1.0)
        stands_deg = wires.world.shaft()[0]
    with start() as bench:
        with pytest.raises(DeviceFault) as still:
            bench.safety.acknowledge()
        assert Do.ACKNOWLEDGE(reboot=True) in still.value.steps
        assert bench.safety.state is TableState.FAULT
        assert bench.safety.acknowledge(reboot=True) is TableState.READY
        assert wires.world.shaft() == (stands_deg, 0.0)
        with Turntable(bench) as table:
            assert table.rest_deg == pytest.approx(stands_deg, abs=0.3)
            table.goto(0.0)
        assert wires.world.shaft()[0] == at_rest(wires.device, 0.0)


def test_reboot_with_changed_settings_keeps_the_fault(start, wires):
    with start() as bench:
        with pytest.raises(Stalled), Turntable(bench) as table:
            wires.device.jam()
            table.goto(60.0)
        wires.device.free()
        wires.device.memory["Operating Mode"] = 3
        with pytest.raises(DeviceMismatch, match="EEPROM"):
            bench.safety.acknowledge(reboot=True)
        assert bench.safety.state is TableState.FAULT


def test_old_goal_of_a_killed_program_is_not_continued(start, wires):
    with start() as bench:
        killed_in_motion(bench, wires, 300.0, after_s=1.0)
    wires.world.clock.sleep(0.2)  # still armed, and rotating
    with start() as bench:
        assert "still armed" in " ".join(bench.findings)
        with Turntable(bench) as table:
            assert wires.world.shaft()[1] == 0
            assert table.rest_deg == pytest.approx(wires.world.shaft()[0], abs=0.3)
            wires.world.clock.sleep(2.0)
            assert wires.world.shaft()[1] == 0


def test_damaged_state_is_reported_and_needs_a_new_reference(tmp_path, start):
    (tmp_path / "state" / "state.json").write_bytes(b'{"version": 1, "tab')
    with start() as bench:
        assert "is damaged" in bench.findings[0]
        assert bench.safety.state is TableState.FAULT
        with pytest.raises(FaultLatched), Turntable(bench):
            pass
        assert bench.safety.acknowledge() is TableState.UNREFERENCED
        bench.safety.set_revolutions(0)
        assert bench.safety.state is TableState.READY


@pytest.mark.parametrize("change", ["table.zero_deg=360", "table.direction=-1", "servo.gear_ratio=1.5"])
def test_changed_settings_of_the_table_need_home_here(change, tmp_path, start, wires):
    with start() as bench, Turntable(bench) as table:
        table.goto(390.0)
    with changed(wires, tmp_path, change) as bench:
        assert bench.safety.state is TableState.UNREFERENCED
        assert bench.safety.doubt.finding is AngleFinding.SETTINGS_CHANGED
        with pytest.raises(Unreferenced) as rejected, Turntable(bench):
            pass
        assert Do.HOME_HERE() in rejected.value.steps
        with pytest.raises(Unreferenced):
            bench.safety.set_revolutions(0)
        bench.safety.set_angle(0.0)
        assert bench.safety.state is TableState.READY
    with changed(wires, tmp_path, change) as bench:
        assert bench.safety.state is TableState.READY


def test_position_beyond_the_limits_is_never_ready(start, wires):
    with start() as bench, Turntable(bench) as table:
        table.goto(390.0)
    wires.world.clock.sleep(wires.device.rotate_by_hand(30.0) + 0.1)
    with start() as bench:
        assert bench.safety.state is TableState.UNREFERENCED
        assert bench.safety.doubt.finding is AngleFinding.BEYOND_LIMITS
        with pytest.raises(Unreferenced, match=r"4[12]\d\.\d°, beyond its cable budget") as rejected, Turntable(bench):
            pass
        assert "by hand back into its limits" in rejected.value.next_step
    wires.world.clock.sleep(wires.device.rotate_by_hand(-30.0) + 0.1)
    with start() as bench, Turntable(bench) as table:
        table.goto(300.0)


@pytest.mark.parametrize("rotations", [-3, 2, 3, 99_999_999])
def test_revolutions_beyond_the_limits_are_rejected_and_not_stored(tmp_path, rotations, start, wires):
    before = (tmp_path / "state" / "state.json").read_bytes()
    with start() as bench, pytest.raises(UsageError, match="cable budget"):
        bench.safety.set_revolutions(rotations)
    assert (tmp_path / "state" / "state.json").read_bytes() == before


def test_full_disk_does_not_lose_the_fault_of_a_motion(start, wires):

    def jam_on_full_disk() -> None:
        nonlocal free
        free = fill_disk()
        wires.device.jam()

    def free() -> None:
        pytest.fail("the disk was never full")

    with start() as bench:
        with pytest.raises((Stalled, NoProgress)), Turntable(bench) as table:
            after(wires, 1.0, jam_on_full_disk)
            table.goto(300.0)
        free()
    wires.device.free()
    with start() as bench:
        assert bench.safety.state is TableState.FAULT
        with pytest.raises(FaultLatched), Turntable(bench):
            pass


def test_stop_request_ends_the_motion_with_torque_off(tmp_path, start, wires):
    with start() as bench:
        with pytest.raises(RigError, match="operator stopped") as stopped, Turntable(bench) as table:
            after(wires, 1.2, FileStore(tmp_path / "state").request_stop)
            table.goto(300.0)
        assert (stopped.value.code, stopped.value.exit_code) == (512, 5)
        assert wires.device.memory["Torque Enable"] == 0
        assert wires.world.shaft()[1] == 0
        assert 20 < wires.world.shaft()[0] < 200
        assert not FileStore(tmp_path / "state").stop_requested()
        with Turntable(bench) as table:  # a stop is no fault
            assert table.goto(0.0).agrees


@pytest.mark.parametrize("after_s", [0.05, 0.3, 0.5, 0.6, 0.7, 0.8])
def test_stop_is_not_reported_as_a_killed_program(tmp_path, start, wires, after_s):
    """Also while the table comes to rest or stands, with its watchdog armed."""
    with pytest.raises(MotionStopped), start() as bench, Turntable(bench) as table:
        after(wires, after_s, FileStore(tmp_path / "state").request_stop)
        table.goto(20.0)
    assert json.loads((tmp_path / "state/session.json").read_bytes())["ended"] == "stopped"
    wires.world.clock.sleep(1.0)  # a watchdog that is still armed would trip
    with start() as bench:
        assert bench.findings == ()


@pytest.mark.parametrize("last", ["", '{"command": "rig home", "since_utc": "2026-01-02"}', "{"])
def test_watchdog_is_explained_by_the_end_of_the_last_session(tmp_path, start, wires, last):
    with start():
        pass
    session = tmp_path / "state/session.json"
    ended = session.read_text()
    for register, words in ((0xFF, "the servo's watchdog stopped it"), (10, "the servo's watchdog was still armed")):
        session.write_text(last)
        wires.device.memory["Bus Watchdog"] = register
        with start() as bench:
            (reported,) = bench.findings
        assert reported.startswith(words)
        assert "the last program" in reported
        assert ("`rig home`, since 2026-01-02" in reported) == ("home" in last)
        session.write_text(ended)
        with start() as bench:  # it ended in an orderly way
            assert not any("the last program" in reported for reported in bench.findings)


@pytest.mark.parametrize("when", ["in a motion", "between two"])
def test_replugged_adapter_is_opened_again_and_checked(simulated, when):
    s = simulated()
    adapter = s.operator.devices.adapter
    with pytest.raises(DeviceSilent) as caught, Turntable(s.bench) as table:
        if when == "in a motion":
            s.world.clock.call_at(s.world.clock.now_ns() + 1_200_000_000, adapter.unplug)
            table.goto(300.0)
        else:
            table.goto(60.0)
            adapter.unplug()
            table.goto(90.0)
    assert ("did not receive the stop" in "".join(getattr(caught.value, "__notes__", ()))) == (when == "in a motion")
    s.world.clock.sleep(1.0)
    stands = s.world.shaft()
    assert stands[1] == 0
    with pytest.raises(DeviceNotFound), Turntable(s.bench):
        pass
    adapter.replug()
    s.world.clock.sleep(3.0)
    assert s.world.shaft() == stands
    with Turntable(s.bench) as table:
        assert s.world.shaft() == stands
        assert table.goto(0.0).encoder_deg == at_rest(s.operator.devices.servo, 0.0)
    with pytest.raises(DeviceSilent), Turntable(s.bench) as table:
        adapter.unplug()
        table.goto(60.0)
    s.operator.devices.servo_bus.detach(s.operator.devices.servo)
    s.operator.devices.servo_bus.attach(SimServo(s.world, "xl330_m288"))
    adapter.replug()
    with pytest.raises(DeviceMismatch) as caught, Turntable(s.bench):
        pass
    assert caught.value.evidence["got"].startswith("xl330_m288")
