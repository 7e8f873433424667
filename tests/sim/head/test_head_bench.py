"""A whole bench with a rig head: its gyro, its light, its relay for the servo, and its e-stop."""

import pytest

from hbr.core.angles import wrap180
from rig.catalog import Catalog, derived
from rig.config import load_config
from rig.core.errors import DeviceSilent, EmergencyStop, FaultLatched, HeadRestarted
from rig.devices.head.head import powered
from rig.devices.head.protocol import Reset
from rig.events.events import Accepted
from rig.motion.turntable import Turntable
from rig.plans.enroll import enroll
from rig.plans.identify import identify
from rig.safety.supervisor import TableState
from rig.search.model import model_of
from sim.bench import ShelfOperator, open_sim_bench
from sim.devices import SimDevices
from sim.objects.shelf import shelf
from sim.world import World
from tests.contract.heads import needs
from tests.firmware.avr import emulated_head

WIRED = ("imu.connection=head", "head.power=true", "head.light=0.8", "table.orientation=imu")


@pytest.fixture
def on_head(simulated, monkeypatch):
    """Return a function that opens a simulated bench on a head of a kind."""

    def open_one(kind: str = "memory", *settings: str):
        needs(kind)
        if kind == "avr":
            monkeypatch.setattr("sim.devices.SimHead", emulated_head)
        return simulated(*WIRED, *settings, seed=4)

    return open_one


@pytest.mark.parametrize("kind", ["memory", pytest.param("avr", marks=pytest.mark.nightly)])
def test_object_is_enrolled_and_found_with_the_heads_gyro_alone(on_head, tmp_path, kind):
    s = on_head(kind, "identify.first_step_deg=90", "table.velocity_dps=180")  # each second is half a second of work
    with Catalog.open(tmp_path, clock=s.bench.clock) as catalog:
        taken = (event for event in enroll(s.bench, catalog, "mug-dots", views=4) if isinstance(event, Accepted))
        truth_deg = [(event.azimuth_deg, -s.world.table_deg()) for event in taken]
        for azimuth_deg, true_deg in truth_deg:
            assert abs(wrap180(azimuth_deg - true_deg)) < 4.0  # an uncalibrated gyro: 1 % of a revolution
        assert any(abs(wrap180(a + round(-a / 90) * 90)) > 0.01 for a, _ in truth_deg)  # and not the encoder's stops
        s.operator.next_object, s.operator.yaw_deg = "mug-dots", 90.0
        *_, answer = identify(s.bench, model_of(derived.views(catalog)))
    assert answer.name == "mug-dots"
    health = s.bench.head.health()
    assert (health["lost"], health["crc_errors"], health["missed"]) == (0, 0, 0)


def test_light_and_servo_power_are_off_before_and_after_a_program(on_head):
    needs("memory")
    s = on_head()
    assert s.operator.devices.head.relay_closed
    assert s.world.scene.light == pytest.approx((1.0,) * 3, abs=0.01)
    s.bench.close()
    assert not s.operator.devices.head.relay_closed
    assert s.world.scene.light == (0.0,) * 3
    assert not s.operator.devices.servo.powered


def test_estop_during_a_motion_stops_the_table_and_latches(on_head):
    s = on_head()
    head = s.operator.devices.head
    with pytest.raises(EmergencyStop), Turntable(s.bench) as table:
        s.world.clock.call_at(s.world.clock.now_ns() + 1_500_000_000, lambda: setattr(head, "estop_open", True))
        table.goto(300.0)
    assert s.bench.safety.state is TableState.FAULT
    assert "e-stop" in s.bench.safety.fault.detail
    stopped_deg = s.world.table_deg()
    assert 1.0 < stopped_deg < 299.0
    assert not head.relay_closed
    with pytest.raises(FaultLatched), Turntable(s.bench):
        pass
    with pytest.raises(EmergencyStop):
        s.bench.safety.acknowledge()  # still pressed
    head.estop_open = False
    s.world.clock.sleep(0.1)
    assert not head.relay_closed  # released alone switches nothing on
    s.bench.safety.acknowledge()
    assert head.relay_closed
    assert s.world.table_deg() == pytest.approx(stopped_deg, abs=2.0)  # nothing moved by itself
    assert s.bench.safety.state in (TableState.READY, TableState.UNREFERENCED)


def test_estop_while_the_table_rests_is_found_before_the_next_motion(on_head):
    s = on_head()
    with pytest.raises(EmergencyStop), Turntable(s.bench) as table:
        table.goto(20.0)
        s.operator.devices.head.estop_open = True
        s.world.clock.sleep(0.2)
        table.goto(40.0)
    assert s.bench.safety.state is TableState.FAULT
    assert s.world.table_deg() == pytest.approx(20.0, abs=1.0)


def test_unplugged_head_ends_the_plan_and_switches_the_servo_off(on_head, tmp_path):
    s = on_head()
    head = s.operator.devices.head
    with Catalog.open(tmp_path, clock=s.bench.clock) as catalog:
        events = enroll(s.bench, catalog, "lamp", views=8)
        with pytest.raises(DeviceSilent):
            for event in events:
                if isinstance(event, Accepted) and event.index == 2:
                    head.unplugged = True
    pulled_ns = s.world.clock.now_ns()
    s.world.clock.sleep(0.5)
    assert not head.relay_closed
    assert head.pulses("relay")[-1][0] - pulled_ns < 260_000_000
    with pytest.raises(DeviceSilent):
        s.bench.close()


def test_next_program_reports_a_killed_program_before_any_motion():
    needs("memory")
    world = World(seed=4)
    operator = ShelfOperator(world, shelf())
    config = load_config(None, WIRED)
    first = open_sim_bench(config, operator)
    devices, wires = operator.devices, first.connections.pop_all()
    first.head._cancel()  # kill -9
    world.clock.sleep(1.0)
    assert not devices.head.relay_closed
    with open_sim_bench(config, operator, devices=devices) as second:
        assert second.safety.state is TableState.FAULT
        with pytest.raises(FaultLatched, match="received nothing"), Turntable(second):
            pass
        assert devices.head.relay_closed  # the servo can be asked how it is; it has no torque
        second.safety.acknowledge()
        assert second.safety.fault is None
        assert second.head.fault is None
    wires.close()


def test_head_supplies_the_servo_unless_a_fault_is_latched():
    needs("memory")
    world, config = World(seed=4), load_config(None, WIRED)
    with SimDevices.connected(config, world) as devices:
        with powered(config, devices.head_port, world.clock):
            assert devices.servo.powered
        assert not devices.servo.powered
        devices.head.reset(Reset.BROWN_OUT)
        with pytest.raises(HeadRestarted), powered(config, devices.head_port, world.clock):
            pass
        assert not devices.servo.powered


def test_pressed_estop_is_reported_with_a_next_step():
    needs("memory")
    world = World(seed=4)
    operator = ShelfOperator(world, shelf())
    config = load_config(None, WIRED)
    with open_sim_bench(config, operator) as bench:
        devices, wires = operator.devices, bench.connections.pop_all()
    devices.head.estop_open = True
    world.clock.sleep(0.1)
    with pytest.raises(EmergencyStop) as caught:
        open_sim_bench(config, operator, devices=devices)
    assert "release" in caught.value.next_step
    wires.close()
