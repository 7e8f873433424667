"""Simulated faults: their notation, their times, their ends and their effects on the simulated devices."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.catalog import Catalog
from rig.config import load_config
from rig.core import files
from rig.core.errors import DeviceMismatch, DeviceSilent, UsageError
from rig.events.events import Accepted, Moved
from rig.plans.enroll import enroll
from sim.bench import SIM, ShelfOperator, SimOptions, open_sim_bench
from sim.devices import SimDevices
from sim.faults import Fault, Faults, fault_kinds
from sim.faults.injector import DURING_S
from sim.faults.kind import FaultTrigger
from sim.objects.shelf import shelf
from sim.world import World
from tests.faults.fault_runs import NOISE
from tests.small import SMALL

VOCABULARY = {
    *(f"{d}.{w}" for d in ("servo", "imu", "camera") for w in ("off", "stuck", "garbage", "wrong", "slow", "delayed")),
    *(f"{d}.intermittent" for d in ("servo", "imu", "camera")),
    *(
        "crc_flip",
        "late_reply",
        "duplicate_reply",
        "babble",
        "echo",
        "unplug",
        "brownout",
        "overload",
        "overheat",
        "watchdog_trip",
    ),
    *(
        "duplicate_id",
        "wrong_model",
        "backlash",
        "slip",
        "friction",
        "jam",
        "object_falls",
        "object_moved",
        "i2c_nack",
        "i2c_stuck",
        "i2c_hang",
    ),
    *("imu.bursts", "imu_saturated", "frozen_frame", "black_frame", "blur", "exposure_jump", "light_flicker"),
    *("mains_flicker", "disk_full", "clock_jump"),
    *("lost_frames", "doubled_frame", "stamp_jump", "stamps_backwards", "stamp_jitter"),
}


@pytest.fixture
def devices():
    with SimDevices.connected(load_config(), World(noise=NOISE)) as devices:
        yield devices


def test_simulator_has_every_documented_fault():
    assert set(fault_kinds()) == VOCABULARY


# -- notation -----------------------------------------------------------------------------------------------------


@st.composite
def faults(draw):
    kind = draw(st.sampled_from(list(fault_kinds().values())))
    values = {}
    for name, parameter in kind.parameters.items():
        low, high = max(parameter.low, -1e6), min(parameter.high, 1e6)
        values[name] = float(f"{draw(st.floats(low, high)):g}")
        values[name] = min(max(values[name], parameter.low), parameter.high)
    trigger = draw(st.sampled_from(FaultTrigger))
    mark = float(draw(st.integers(0, 999)))
    for_s = draw(st.none() | st.sampled_from((0.5, 2.0, 31.0)))
    return Fault(kind, values, trigger, mark, for_s)


@given(faults())
def test_fault_is_read_as_it_was_written(fault):
    assert Fault.parse(str(fault)) == fault


@given(
    st.text(max_size=30) | st.from_regex(r"[a-z_.]{1,8}(:[a-z]{1,5}=[0-9.e-]{0,4})?(@[a-z0-9+.]{0,8})?", fullmatch=True)
)
def test_any_text_is_read_or_rejected_with_a_next_step(text):
    rejection = None
    try:
        fault = Fault.parse(text)
    except UsageError as error:
        rejection = error
    assert rejection.next_step if rejection else fault.kind.name in text


@pytest.mark.parametrize(
    ("text", "what", "next_step"),
    [
        ("jim", "no fault 'jim'", "mean"),
        ("off", "no fault 'off'", "servo.off or imu.off or camera.off"),
        ("nonsense", "no fault", "rig faults"),
        ("jam@", "Cannot read", "NAME"),
        ("jam@3", "Cannot read", "12s, move3 or view10"),
        ("jam@move", "Cannot read", "move3"),
        ("jam@move1.5", "Cannot read", "move3"),
        ("jam:tight", "Cannot read", "PARAMETER=VALUE"),
        ("jam:for_s=3", "no parameter 'for_s'", "Remove"),
        ("jam:tight=3", "no parameter 'tight'", "Remove"),
        ("slip:angel=3", "no parameter 'angel'", "angle, seconds"),
        ("slip:angle=far", "angle = 'far'", "number"),
        ("slip:angle=nan", "angle = 'nan'", "number"),
        ("crc_flip:rate=2", "rate = 2 is out of range", "0 to 1"),
        ("jam@3s+0s", "no duration", "above 0"),
    ],
)
def test_invalid_fault_is_rejected_with_a_correction(text, what, next_step):
    with pytest.raises(UsageError) as rejected:
        Fault.parse(text)
    assert what in rejected.value.what
    assert next_step in rejected.value.next_step


def test_configuration_with_an_invalid_fault_is_rejected():
    with pytest.raises(ValueError, match="Did you mean"):
        SimOptions(faults=["jamm"])
    config = load_config(overrides=['bench.sim.faults=["wrong_model"]'])
    with pytest.raises(DeviceMismatch, match="not the configured model"):
        SIM.open(config, SimOptions(**config.bench["sim"]), 0)


# -- times ----------------------------------------------------------------------------------------------------------


def test_fault_begins_and_ends_at_its_times(devices):
    faults = Faults(devices)
    reported = []
    faults.listeners.append(lambda occurrence: reported.append((occurrence.began, occurrence.time_ns * 1e-9)))
    faults.schedule(Fault.parse("i2c_stuck@2s+3s"))
    devices.world.clock.sleep(1.999)
    assert not devices.i2c.stuck
    devices.world.clock.sleep(0.001)
    assert devices.i2c.stuck
    assert [fault.kind.name for fault in faults.active] == ["i2c_stuck"]
    devices.world.clock.sleep(3.0)
    assert not devices.i2c.stuck
    assert reported == [(True, 2.0), (False, 5.0)]


def test_clear_ends_active_faults_and_cancels_scheduled_ones(devices):
    faults = Faults(devices)
    faults.schedule(Fault.parse("i2c_stuck"), Fault.parse("unplug@2s"), Fault.parse("blur@view0"))
    assert devices.i2c.stuck
    faults.clear()
    devices.world.clock.sleep(3.0)
    assert not devices.i2c.stuck
    assert devices.adapter.is_open
    assert not faults.active


@pytest.mark.parametrize("name", sorted(VOCABULARY))
def test_ended_fault_leaves_no_hook(devices, name):
    before = _hooks(devices)
    faults = Faults(devices)
    faults.schedule(Fault.parse(name))
    devices.world.clock.sleep(0.3)
    faults.clear()
    devices.world.clock.sleep(0.5)  # the servo boots
    assert _hooks(devices) == before
    assert devices.world.clock.next_event_ns() is None  # nothing is scheduled any more


def _hooks(devices):
    return [
        *(len(hooks) for hooks in (devices.servo_bus.filters, devices.servo.distortions, devices.imu.distortions)),
        *(len(hooks) for hooks in (devices.i2c.nack_conditions, devices.camera.filters, devices.camera.grab_failures)),
        len(devices.servo_bus._devices),
        *(devices.servo_bus.echo, devices.i2c.stuck, devices.i2c.held, devices.camera.hangs),
        *(devices.camera.every, devices.camera.latency_ns, devices.camera.blur_px, devices.world.noise),
        *(
            devices.servo.powered,
            devices.servo.memory["Model Number"],
            devices.world.scene.light,
            devices.world.scene.object,
        ),
    ]


def test_moves_and_views_have_the_numbers_of_the_plan(tmp_path):
    """Also if a move has two steps, and if a frame is repeated."""
    world = World(seed=5)
    operator = ShelfOperator(world, shelf())
    planned = [Fault.parse(text) for text in ("clock_jump@move0", "clock_jump@move2", "black_frame@view2+0.3s")]
    begun = {}
    with (
        open_sim_bench(load_config(None, SMALL), operator, faults=planned) as bench,
        Catalog.open(tmp_path, clock=bench.clock) as c,
    ):
        assert operator.faults is not None
        operator.faults.listeners.append(lambda o: begun.setdefault((o.fault.trigger, o.fault.mark), o.time_ns))
        moves, views = {}, {}
        for event in enroll(bench, c, "dice", views=6):
            if isinstance(event, Moved):
                moves[event.index] = (world.clock.now_ns() - round(event.seconds * 1e9), world.clock.now_ns())
            if isinstance(event, Accepted):
                views[event.index] = event.evidence.exposed_ns
    for index in (0, 2):
        set_off_ns, arrived_ns = moves[index]
        assert set_off_ns + DURING_S * 1e9 <= begun[FaultTrigger.MOVE, index] <= arrived_ns
    assert views[2] < begun[FaultTrigger.VIEW, 2] < moves[3][1]


# -- effects on the devices -------------------------------------------------------------------------------------


def test_same_seed_gives_the_same_fault():
    def noise(seed: int) -> bytes:
        with SimDevices.connected(load_config(), World(seed=seed)) as devices:
            Faults(devices).schedule(Fault.parse("camera.garbage"))
            devices.camera.grab()
            return bytes(np.asarray(devices.camera.retrieve()[1])[:4])

    assert noise(1) == noise(1)
    assert noise(1) != noise(2)


def test_full_disk_rejects_every_file_until_the_fault_ends(devices, tmp_path):
    faults = Faults(devices)
    faults.schedule(Fault.parse("disk_full"))
    with pytest.raises(OSError, match="No space left"):
        files.write(tmp_path / "a", b"a")
    faults.clear()
    files.write(tmp_path / "a", b"a")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_clock_jump_changes_civil_time_but_not_the_monotonic_clock(devices):
    before, before_ns = devices.world.clock.utc(), devices.world.clock.now_ns()
    Faults(devices).schedule(Fault.parse("clock_jump:seconds=60"))
    assert (devices.world.clock.utc() - before).total_seconds() == 60
    assert devices.world.clock.now_ns() == before_ns


def test_bursts_have_the_recorded_intervals_between_host_times(devices):
    """Samples of 100 Hz over ten minutes, each of which takes 2 ms to arrive, as in the recording of a real gyro."""
    Faults(devices).schedule(Fault.parse("imu.bursts"))
    arrived = [0.0]
    for due_ns in range(10_000_000, 600_000_000_000, 10_000_000):
        arrived.append(max(devices.i2c.held(due_ns) * 1e-6, arrived[-1] + 2))
    median, most, longest = np.quantile(np.diff(arrived), [0.5, 0.95, 1.0])
    assert median == pytest.approx(2, abs=0.2)
    assert most == pytest.approx(48, rel=0.2)
    assert longest == pytest.approx(500, rel=0.2)


def test_fault_at_the_start_stops_the_bench_from_opening():
    with pytest.raises(DeviceMismatch, match="not the configured model"):
        open_sim_bench(load_config(), ShelfOperator(World(), shelf()), faults=[Fault.parse("wrong_model")])


SERVOS = ("xl430_w250", "xm430_w350", "xl330_m288", "mx_28")
IMUS = (("mpu6050", 0x68), ("mpu6500", 0x68), ("bno055", 0x28))


@pytest.mark.parametrize(
    ("servo", "imu"),
    [
        pytest.param(servo, imu, marks=[pytest.mark.nightly] * (i % len(IMUS) != j))  # each device once, and all pairs
        for i, servo in enumerate(SERVOS)
        for j, imu in enumerate(IMUS)
    ],
)
def test_every_fault_works_on_every_simulated_device(servo, imu):
    settings = (f"servo.model={servo}", "servo.baud=1000000", f"imu.model={imu[0]}", f"imu.address={imu[1]}")
    for name in fault_kinds():
        with SimDevices.connected(load_config(None, settings), World(noise=NOISE)) as devices:
            faults = Faults(devices)
            faults.schedule(Fault.parse(name))
            devices.world.clock.sleep(0.3)
            faults.clear()


@pytest.mark.sim(seed=2, faults=["camera.off@view1", "clock_jump@2s"])
def test_fixtures_of_the_pytest_plugin_take_faults(sim_bench, sim_catalog):
    with pytest.raises(DeviceSilent):
        list(enroll(sim_bench, sim_catalog, "dice", views=4))
    unfinished = sim_catalog.resumable("dice")
    assert unfinished.enrollment.present == (0,)  # the second frame came, but its locks could not be read
    assert [occurrence.fault.kind.name for occurrence in sim_bench.placer.faults.history] == [
        "clock_jump",
        "camera.off",
    ]
