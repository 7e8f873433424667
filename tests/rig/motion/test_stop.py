"""A stop stays within the limits, uses only readings that agree, and ends with the torque off and read back."""

import ast
import os
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

import pytest

from rig.config import load_config
from rig.core.clock import seconds_between
from rig.core.errors import BenchBusy, DeviceSilent, MotionStopped, TorqueStaysOn, UsageError
from rig.devices.servo import ServoState
from rig.jobs.stop import stop
from rig.motion.arrival import stopping_deg
from rig.motion.turntable import Turntable
from rig.safety.saved_state import BenchLock, Holder
from rig.safety.stop_channel import listen
from rig.safety.supervisor import TableState
from sim.world import World
from tests.rig.bench_parts import motion_bench, open_servo, servo_wires

FAST = "table.velocity_dps=200", "table.acceleration_dps2=500", "imu.range_dps=500"


class Interrupted(BaseException):
    pass


def keep_torque_on(wires) -> None:
    """Have the servo acknowledge the instruction to switch its torque off, but not carry it out."""
    device = wires.device
    write, torque_off = device._write, (64, b"\0")
    device._write = lambda address, data: None if (address, data) == torque_off else write(address, data)


def interrupt_at(bench, wires, angle_deg: float) -> None:
    """Interrupt the control loop when the table has reached ``angle_deg``."""
    read_state = bench.servo.read_state

    def read():
        state = read_state()
        if bench.safety.angle_reference.to_table(state.position_deg) >= angle_deg:
            bench.servo.read_state = read_state
            raise Interrupted
        return state

    bench.servo.read_state = read


@pytest.mark.parametrize("speed", [(), FAST], ids=["90 °/s", "200 °/s"])
@pytest.mark.parametrize(
    "pause_after_reads", [1, *(pytest.param(reads, marks=pytest.mark.nightly) for reads in (0, 2, 3))]
)
def test_stop_stays_within_the_limits_after_a_pause_of_the_computer(speed, pause_after_reads):
    with motion_bench(*speed) as (bench, wires):
        table = Turntable(bench, trust_gyro=False)
        clock, highest = wires.world.clock, [0.0]
        with pytest.raises(Interrupted), table:
            table.goto(100.0)
            interrupt_at(bench, wires, 360.0)
            stop = table._stop

            def stop_with_pause() -> bool:
                read_state, reads = bench.servo.read_state, [0]

                def read():
                    state = read_state()
                    reads[0] += 1
                    if reads[0] == pause_after_reads:
                        clock.sleep(0.3)  # the computer pauses; the watchdog is longer than that
                    return state

                bench.servo.read_state = read
                if not pause_after_reads:
                    clock.sleep(0.3)
                return stop()

            table._stop = stop_with_pause

            def watch() -> None:
                highest[0] = max(highest[0], wires.world.table_deg())
                clock.call_at(clock.now_ns() + 5_000_000, watch)

            watch()
            table.goto(400.0)
        clock.sleep(1.0)
        assert 360.0 < highest[0] < 401.0
        assert wires.device.memory["Torque Enable"] == 0


@pytest.mark.parametrize("jumps_deg", [(360.0, -90.0), pytest.param((-360.0, 180.0), marks=pytest.mark.nightly)])
def test_reading_that_jumps_by_a_revolution_does_not_become_a_goal(jumps_deg):
    for jump_deg in jumps_deg:
        for wrong_reads in (1, 2, 3):
            with motion_bench() as (bench, wires):
                table = Turntable(bench, trust_gyro=False)
                highest = [0.0]
                clock = wires.world.clock

                def watch(wires=wires, clock=clock, highest=highest) -> None:
                    highest[0] = max(highest[0], wires.world.table_deg())
                    clock.call_at(clock.now_ns() + 5_000_000, lambda: watch())

                with pytest.raises(Interrupted), table:
                    interrupt_at(bench, wires, 150.0)
                    stop = table._stop

                    def stop_with_jump(stop=stop, bench=bench, jump_deg=jump_deg, wrong_reads=wrong_reads) -> bool:
                        read_state, left = bench.servo.read_state, [wrong_reads]

                        def read():
                            state = read_state()
                            left[0] -= 1
                            return replace(state, position_deg=state.position_deg + jump_deg * (left[0] >= 0))

                        bench.servo.read_state = read
                        return stop()

                    table._stop = stop_with_jump
                    watch()
                    table.goto(400.0)
                clock.sleep(1.0)
                assert 150.0 < highest[0] < 200.0
                assert highest[0] - wires.world.table_deg() < 1.0, (jump_deg, wrong_reads)
                assert wires.device.memory["Torque Enable"] == 0


def test_goals_are_written_in_one_place_only():
    calls = [
        (path.name, node.lineno)
        for folder in ("rig", "calibration")
        for path in Path(folder).rglob("*.py")
        if "move_to" in (content := path.read_text(encoding="utf-8"))
        for node in ast.walk(ast.parse(content))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "move_to"
    ]
    assert [name for name, _ in calls] == ["supervisor.py"]


@pytest.mark.parametrize("angle_deg", [float("nan"), float("inf"), -float("inf")])
def test_angle_that_is_no_number_is_a_usage_error(angle_deg):
    with motion_bench() as (bench, _), Turntable(bench) as table, pytest.raises(UsageError):
        table.goto(angle_deg)


def test_servo_whose_torque_stays_on_is_reported_and_latched():
    with motion_bench() as (bench, wires):
        with pytest.raises(TorqueStaysOn) as caught, Turntable(bench):
            keep_torque_on(wires)
        assert caught.value.exit_code == 5
        assert bench.safety.state is TableState.FAULT
        assert bench.safety.fault.code == TorqueStaysOn.code


def test_torque_that_stays_on_is_reported_instead_of_the_interruption():
    with motion_bench() as (bench, wires), pytest.raises(TorqueStaysOn), Turntable(bench):
        keep_torque_on(wires)
        raise KeyboardInterrupt


@pytest.mark.parametrize("damaged", [1, 2, 3])
def test_instruction_that_arrives_damaged_is_repeated(damaged, monkeypatch):
    wires = servo_wires()
    servo = open_servo(wires)
    servo.torque_on()
    write, left = wires.serial.write, [damaged]

    def damage(data: bytes) -> int:
        left[0] -= 1
        return write(data if left[0] < 0 else data[:-1] + bytes((data[-1] ^ 1,)))

    monkeypatch.setattr(wires.serial, "write", damage)
    servo.torque_off()
    assert wires.device.memory["Torque Enable"] == 0
    assert servo.bus.statistics.corrupt == damaged


def test_bus_that_damages_every_instruction_counts_as_silent(monkeypatch):
    wires = servo_wires()
    servo = open_servo(wires)
    write = wires.serial.write
    monkeypatch.setattr(wires.serial, "write", lambda data: write(data[:-1] + bytes((data[-1] ^ 1,))))
    with pytest.raises(DeviceSilent, match="does not answer"):
        servo.torque_off()


@pytest.mark.parametrize("pid", [os.getpid(), 1, 0], ids=["usual", "first of a container", "unknown"])
def test_program_that_does_not_answer_is_signalled_after_two_seconds(tmp_path, monkeypatch, pid):
    clock, config, signalled = World().clock, load_config(None, [f"state_dir={str(tmp_path)!r}"]), []
    path = config.state_path("sim")
    with ExitStack() as program:
        program.enter_context(closing(BenchLock(path, clock)))
        program.enter_context(closing(listen(path)))
        (path / "lock").write_text(Holder(pid=pid, command="rig", since_utc="2026-01-02").model_dump_json())
        start_ns = clock.now_ns()

        def kill(pid: int, _number: int) -> None:
            signalled.append((pid, seconds_between(start_ns, clock.now_ns())))
            program.close()

        monkeypatch.setattr("os.kill", kill)
        if pid:
            assert stop("sim", config, clock).signalled
            assert signalled == [(pid, pytest.approx(2.0, abs=0.05))]
        else:  # 0 would signal this program, too
            with pytest.raises(BenchBusy):
                stop("sim", config, clock)
            assert not signalled


@pytest.mark.parametrize(
    ("profile", "stops_deg"),
    [
        ((104.0, 90.0), 104.0 + 90.0**2 / 480),  # it brakes from where it is, 4° ahead of the shaft
        ((101.0, 0.0), 101.0),  # it has ended, and the shaft still moves there
        ((113.0, 90.0), 100.0 + 48.0**2 / 480),  # something holds the table, and the profile continues alone
        ((460.0, 90.0), 100.0 + 48.0**2 / 480),  # a false reading
        ((None, None), 100.0 + 48.0**2 / 480),
    ],
)
def test_table_stops_where_its_profile_can_brake_unless_the_table_does_not_follow_it(profile, stops_deg):
    state = ServoState(0, 100.0, 48.0, 10.0, 12.0, 33.0, True, False, (), *profile)
    assert stopping_deg(state, 240.0, 0.0, 12.0) == pytest.approx(stops_deg)


@pytest.mark.parametrize("after_s", [0.3, 0.45, 0.7])
def test_a_stop_is_seen_while_the_gyro_is_averaged_before_the_first_move(after_s):
    with motion_bench() as (bench, wires):
        clock, asked_ns = wires.world.clock, []

        def press():
            asked_ns.append(clock.now_ns())
            bench.state.request_stop()

        clock.call_at(clock.now_ns() + round(after_s * 1e9), press)
        with pytest.raises(MotionStopped), Turntable(bench, first_rest_s=1.0):
            pass
        assert (clock.now_ns() - asked_ns[0]) * 1e-9 < 0.1
        assert wires.device.memory["Torque Enable"] == 0
