"""docs/how-to/add-an-imu.md: the page's package is put on the path, and the rig uses its sensor."""

from pkgutil import resolve_name

import pytest

from rig import Catalog, enroll
from rig.config import load_config
from rig.config.imus import imu_kinds
from rig.core.errors import ConfigError, DeviceMismatch
from rig.devices.imu import open_imu
from rig.doctor.device_scan import DeviceScan
from rig.events.events import Moved
from sim.bench import ShelfOperator, open_sim_bench
from sim.imu.mpu6050 import SimMpu6050
from sim.noise import NoiseModel
from sim.objects.shelf import shelf
from sim.world import World
from tests.contract import test_imu as contract
from tests.docs.pages import blocks, install
from tests.rig.doctor.doctor_parts import unopened

CHOSEN = "imu.model=lsm6dsox"


@pytest.fixture(autouse=True)
def package(monkeypatch, tmp_path):
    driver, simulator = blocks("add-an-imu")
    (toml,) = blocks("add-an-imu", "toml")
    monkeypatch.syspath_prepend(install(tmp_path / "package", {"lsm6dsox": driver, "sim_lsm6dsox": simulator}, toml))


def test_new_imu_measures_the_rotations_of_an_enrollment(tmp_path):
    config = load_config(None, [CHOSEN])
    assert config.imu.address == 0x6A
    with (
        open_sim_bench(config, ShelfOperator(World(seed=1), shelf())) as bench,
        Catalog.open(tmp_path / "catalog", clock=bench.clock) as catalog,
    ):
        assert bench.imu.identity.model == "LSM6DSOX"
        moves = [e for e in enroll(bench, catalog, "lamp", views=8) if isinstance(e, Moved)]
    assert all(move.agrees for move in moves)


def test_search_and_doctor_name_the_new_imu():
    with unopened(CHOSEN) as bench:
        scan = DeviceScan()
        assert [found.code for found in scan.find_imus(bench.context)] == ["imu_found"]
        (candidate,) = scan.candidates["IMU"]
        assert candidate == {("imu", "model"): "lsm6dsox", ("imu", "bus"): 1, ("imu", "address"): 0x6A}
        assert not bench.problems("imu")
        bench.devices.i2c.detach(0x6A)
        bench.devices.i2c.attach(0x6A, SimMpu6050(bench.devices.world))
        assert bench.problems("imu")


def passes(check, *parameters):
    row = imu_kinds()["lsm6dsox"]
    driver, simulator = resolve_name(row.driver), resolve_name(row.simulator)
    with contract.on_i2c(driver, simulator, 0x6A, 0.006, 0.3)(NoiseModel.none()) as sensor:
        check(sensor, *parameters)


def test_new_imu_passes_the_contract():
    passes(contract.test_samples_come_once_in_order_at_the_rate_of_the_identity)
    passes(contract.test_counter_clockwise_is_positive, -100.0)
    passes(contract.test_integral_between_two_rests_is_the_rotation, 37.0)
    passes(contract.test_sample_times_are_those_of_the_rotation)
    passes(contract.test_late_read_reports_lost_samples)
    passes(contract.test_gravity_points_up_with_its_norm)
    passes(contract.test_pulled_cable_is_an_error_and_closing_twice_is_harmless)


def test_other_sensor_at_the_address_is_rejected():
    config = load_config(None, [CHOSEN, "imu.address=0x69"])
    with unopened("imu.address=0x69") as bench, pytest.raises(DeviceMismatch) as caught:
        open_imu(config.imu, bench.devices.i2c.path, bench.devices.world.clock)
    assert caught.value.evidence["expected"] == 0x6C


def test_package_that_cannot_be_loaded_is_a_configuration_error(monkeypatch, tmp_path):
    toml = '[project.entry-points."rig.imus"]\nbroken = "no_such_module:KIND"\n'
    monkeypatch.syspath_prepend(install(tmp_path / "broken", {}, toml))
    assert load_config(None, []).imu.model == "mpu6050"
    with pytest.raises(ConfigError, match="no_such_module"):
        load_config(None, ["imu.model=broken"])


def test_sensor_without_a_driver_is_not_a_model():
    with pytest.raises(ConfigError) as caught:
        load_config(None, ["imu.model=icm20948"])
    assert "lsm6dsox" in str(caught.value.evidence)
