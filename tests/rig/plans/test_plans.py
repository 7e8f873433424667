"""Enrollments end to end: real drivers, simulated buses, a catalog on disk."""

import json

import pytest

import hbr
from hbr.core.angles import wrap180
from rig.catalog import Catalog
from rig.catalog.describing import FEWEST_VIEWS, described
from rig.core.errors import (
    CameraSettingsDiffer,
    DeviceSilent,
    RigError,
    RotationDisagreement,
    ViewRejected,
)
from rig.core.next_steps import Do
from rig.events.events import Accepted, Enrolled, Moved, Rejected, Started, event_dict
from rig.plans.enroll import enroll
from rig.plans.identify import identify
from rig.plans.photograph_table import photograph_table
from rig.search.model import load_model
from rig.views.description import BENCH_DESCRIPTOR, PAPER_DESCRIPTOR, EnrollmentDescriber

VIEWS = 8


@pytest.fixture
def catalog(tmp_path, simulated):
    clock = simulated().bench.clock
    with Catalog.open(tmp_path / "catalog", clock=clock) as catalog:
        yield catalog


def torque(s) -> int:
    """Return the torque register of the simulated servo."""
    return s.bench.servo._read("Torque Enable")


def test_enrollment_stores_every_view_at_the_angle_it_was_taken(simulated, catalog):
    s = simulated(seed=4)
    truth = []
    events = []
    for event in enroll(s.bench, catalog, "teapot", views=VIEWS, label="kitchen"):
        events.append(event)
        if isinstance(event, Accepted):
            truth.append(s.world.table_deg(event.evidence.exposed_ns))
    assert isinstance(events[0], Started)
    assert isinstance(events[-1], Enrolled)
    details = catalog.object("teapot")
    assert details.summary.views == VIEWS
    assert details.summary.label == "kitchen"
    for view, true_deg in zip(details.views, truth, strict=True):
        assert view.encoder_deg == pytest.approx(true_deg, abs=0.3)
        assert view.imu_deg == pytest.approx(true_deg, abs=max(4 * view.imu_sigma_deg, 0.3))
        assert wrap180(view.azimuth_deg + view.encoder_deg) == pytest.approx(0, abs=1e-6)
        assert view.evidence["exposed_ns"] >= view.evidence["settled_ns"]
        assert view.region == s.bench.config.view.roi
    assert torque(s) == 0


@pytest.mark.parametrize("interrupted_after", [1, *(pytest.param(one, marks=pytest.mark.nightly) for one in (None, 5))])
def test_enrolled_views_are_described_together(simulated, catalog, interrupted_after):
    """The pixels come from memory or from the disk; few views of a session learn the background from all sessions."""
    s = simulated(seed=4)
    list(photograph_table(s.bench))
    plan = enroll(s.bench, catalog, "teapot", views=VIEWS)
    if interrupted_after is not None:
        for event in plan:
            if isinstance(event, Accepted) and event.index == interrupted_after:
                break
        plan.close()
        plan = enroll(s.bench, catalog, "teapot", resume=True)
    list(plan)
    stored = catalog.object("teapot").complete
    images = [catalog.read_image(view.image) for view in stored.views]
    tables = [catalog.read_image(session.empty_table) for session in stored.sessions]
    sessions = [view.session for view in stored.views]
    found = described(catalog.database, stored, "teapot")
    for index, image in enumerate(images):
        own = [n for n, session in enumerate(sessions) if session == sessions[index]]
        learned = own if len(own) >= FEWEST_VIEWS else range(VIEWS)
        describer = EnrollmentDescriber(s.bench.config.view, (BENCH_DESCRIPTOR,), tables[sessions[index]])
        numbers = {n: describer.learn(images[n]) for n in learned}
        expected = describer.describe(numbers[index], image)
        x, y, width, height = s.bench.config.view.roi
        paper = hbr.describe(image[y : y + height, x : x + width])
        assert (found.levels[BENCH_DESCRIPTOR][index] == expected.levels[BENCH_DESCRIPTOR]).all()
        assert (found.levels[PAPER_DESCRIPTOR][index] == paper).all()
        assert found.segmentation[index] == expected.segmentation


def test_unlocked_exposure_of_the_camera_is_a_note(simulated, catalog):
    s = simulated("camera.exposure_us=none")
    s.bench.placer.place("dice")
    with pytest.raises(ViewRejected) as rejected:
        for _ in enroll(s.bench, catalog, "dice", views=4):
            s.world.change(light=(0.4, 0.4, 0.4))
    assert "camera.exposure_us" in rejected.value.next_step
    assert catalog.objects() == []


def test_identify_is_rejected_if_the_camera_has_other_settings_than_at_the_enrollment(simulated, catalog):
    list(enroll(simulated().bench, catalog, "dice", views=4))
    s = simulated("camera.gain=6", "camera.sharpness=90")
    with pytest.raises(CameraSettingsDiffer) as rejected:
        next(identify(s.bench, load_model(catalog)))
    assert rejected.value.evidence == {
        "gain": "6.0 now, 0.0 at the enrollment",
        "sharpness": "90.0 now, 3.0 at the enrollment",
    }
    assert rejected.value.steps[:2] == (
        Do.SET_KEY(key="camera.gain", value="0"),
        Do.SET_KEY(key="camera.sharpness", value="3"),
    )
    next(identify(simulated().bench, load_model(catalog)))


def test_enrollment_is_not_continued_with_other_settings_of_the_camera(simulated, catalog):
    events = enroll(simulated().bench, catalog, "dice", views=4)
    while not isinstance(next(events), Accepted):
        pass
    events.close()
    with pytest.raises(CameraSettingsDiffer):
        next(enroll(simulated("camera.gain=6").bench, catalog, "dice", resume=True))
    assert isinstance(next(enroll(simulated().bench, catalog, "dice", resume=True)), Started)


@pytest.mark.nightly
def test_each_view_is_stored_before_the_next_rotation(simulated, catalog):
    s = simulated()
    stored = 0
    for event in enroll(s.bench, catalog, "dice", views=6):
        if isinstance(event, Moved):
            assert len(catalog.resumable("dice").enrollment.present) == stored
        if isinstance(event, Accepted):
            stored += 1
            assert len(catalog.resumable("dice").enrollment.present) == stored


def test_torque_that_cannot_be_switched_off_is_an_error_after_an_interruption(simulated):
    s = simulated()
    with pytest.raises(DeviceSilent, match="Torque Enable = 0") as caught, s.bench:
        s.bench.servo.bus.port.ser.unplug()
        raise KeyboardInterrupt
    assert isinstance(caught.value.__context__, KeyboardInterrupt)


def test_torque_that_cannot_be_switched_off_is_noted_on_an_earlier_error(simulated):
    s = simulated()
    with pytest.raises(ValueError, match="first") as caught, s.bench:
        s.bench.servo.bus.port.ser.unplug()
        raise ValueError("first")
    assert any("does not answer" in note for note in caught.value.__notes__)


def servo_of(s):
    """Return the simulated servo of a bench."""
    return s.bench.servo.bus.port.ser._bus._devices[0]


@pytest.mark.parametrize("moving", [True, False])
def test_supply_dip_of_the_servo_ends_the_plan_and_nothing_moves_afterwards(simulated, catalog, moving):
    s = simulated()
    with pytest.raises(RigError) as caught:
        for event in enroll(s.bench, catalog, "lamp", views=8):
            if moving and isinstance(event, Accepted) and event.index == 2:
                s.world.clock.call_at(s.world.clock.now_ns() + 400_000_000, servo_of(s).power_cycle)
            if not moving and isinstance(event, Moved) and event.index == 2:
                servo_of(s).power_cycle()
                s.world.clock.sleep(0.5)
    assert caught.value.exit_code in (4, 5, 6)
    assert set(catalog.resumable("lamp").enrollment.present) <= {0, 1, 2}
    assert torque(s) == 0
    before = s.world.shaft()[0]
    s.world.clock.sleep(2.0)
    assert s.world.shaft()[0] == before


@pytest.mark.parametrize(
    ("end", "kind"),
    [*(("closed", kind) for kind in (Started, Moved, Rejected, Accepted)), ("forgotten", Accepted)],
)
def test_plan_that_is_closed_at_any_event_switches_the_torque_off(simulated, catalog, end, kind):
    s = simulated()
    if kind is Rejected:
        s.world.change(light=(0.0, 0.0, 0.0))
    plan = enroll(s.bench, catalog, "lamp", views=4)
    assert any(isinstance(event, kind) for event in plan)
    if end == "closed":
        plan.close()
    del plan
    assert torque(s) == 0


def test_plan_can_be_closed_after_its_bench(simulated, catalog):
    s = simulated()
    plan = enroll(s.bench, catalog, "lamp", views=4)
    assert any(isinstance(event, Accepted) for event in plan)
    s.bench.close()
    assert servo_of(s).memory["Torque Enable"] == 0
    plan.close()


def test_rotation_beyond_the_gyro_range_ends_the_enrollment_before_a_wrong_angle_is_stored(simulated, catalog):
    s = simulated()
    with pytest.raises(RotationDisagreement, match="not known"):
        for event in enroll(s.bench, catalog, "dice", views=6):
            if isinstance(event, Accepted) and event.index == 2:
                s.world.clock.call_at(s.world.clock.now_ns() + 400_000_000, lambda: s.world.slip(-10.0))
    assert catalog.resumable("dice").enrollment.present == (0, 1, 2)


def test_events_are_valid_json_without_gyro_values(simulated, catalog):
    s = simulated()
    rejected = []
    for event in enroll(s.bench, catalog, "dice", views=4):
        json.dumps(event_dict(event), allow_nan=False)
        if isinstance(event, Moved):
            s.world.clock.sleep(10.0)  # longer than the gyro's memory
        if isinstance(event, Rejected):
            rejected.append(event_dict(event)["evidence"]["stillness"]["peak_rate_dps"])
    assert None in rejected


def test_resume_finishes_an_enrollment_that_has_all_its_views(simulated, catalog):
    s = simulated()
    plan = enroll(s.bench, catalog, "dice", views=4)
    for event in plan:
        if isinstance(event, Accepted) and event.index == 3:
            break
    plan.close()
    assert catalog.object("dice").summary.views == 0
    events = list(enroll(s.bench, catalog, "dice", resume=True))
    assert [type(event) for event in events] == [Started, Enrolled]
    assert catalog.object("dice").summary.views == 4
    found = described(catalog.database, catalog.object("dice").complete, "dice")
    assert {one["together"] for one in found.segmentation} == {4}
