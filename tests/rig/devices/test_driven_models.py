"""Every model of the SDK: it is moved by its own counts and units on the simulated wire, or rejected by its name.

The `.model` files are read here once more. Resolution and units are the e-manual's, written here a second time.
"""

from dataclasses import dataclass
from importlib.resources import files

import pytest

from rig.config import load_config
from rig.config.servos import USE_ANOTHER, DynamixelModel, known_model
from rig.core.errors import ConfigError, DeviceMismatch
from rig.devices.dynamixel.registers import control_table, model_numbers
from rig.devices.dynamixel.servo import DynamixelServo
from rig.devices.servo import MotionProfile
from rig.doctor.device_scan import DeviceScan
from sim.noise import NoiseModel
from tests.rig.bench_parts import open_bus, servo_wires
from tests.rig.doctor.doctor_parts import unopened

FOLDER = files("dynamixel_easy_sdk") / "control_table"
FILES = sorted(path.name.removesuffix(".model") for path in FOLDER.iterdir() if path.name.endswith(".model"))
NUMBERS = {
    name.removesuffix(".model"): int(number)
    for number, name in (line.split() for line in (FOLDER / "dynamixel.model").read_text().splitlines()[1:])
}
REJECTED = {name for name in NUMBERS if name.startswith("ym") or name in ("xl320", "rh_p12_rn")}
WRITE = 0x03


@dataclass(frozen=True)
class Series:
    """What the e-manual says about a series: counts, rev/min and rev/min² for each unit, the largest goal."""

    counts: int
    rpm: float
    rpm2: float
    extended: int


X = Series(4096, 0.229, 214.577, 1_048_575)
SERIES = {
    **dict.fromkeys(("x", "2x", "mx"), X),
    **dict.fromkeys(("ph54", "h54"), Series(1_003_846, 0.01, 1.0, 2**31 - 1)),
    **dict.fromkeys(("ph42", "h42"), Series(607_500, 0.01, 1.0, 2**31 - 1)),
    **dict.fromkeys(("pm54", "m54"), Series(502_834, 0.01, 1.0, 2**31 - 1)),
    **dict.fromkeys(("pm42", "m42"), Series(526_374, 0.01, 1.0, 2**31 - 1)),
}


def places(file: str) -> dict[str, tuple[int, int]]:
    """Return address and size of each register in a `.model` file."""
    rows = (FOLDER / f"{file}.model").read_text().partition("[control table]")[2].splitlines()
    cells = [row.split("\t") for row in rows if row[:1].isdigit()]
    return {name.replace("BUS", "Bus"): (int(address), int(size)) for address, size, name in cells}


def driven_on_a_wire(file: str):
    """Return simulated wires and the driver of the servo of a `.model` file, with the settings that it needs."""
    model, new, _ = file.partition("_fw52")
    wires = servo_wires(NoiseModel.none(), model=model, firmware=52 if new else 44)
    servo = DynamixelServo(open_bus(wires), bus_id=1, model=model, clock=wires.world.clock)
    servo.prepare(write=True)
    return wires, servo


def written(wires, place: tuple[int, int]) -> list[int]:
    """Return the values that the host has written to a place of the servo's memory."""
    address, size = place
    sent = [frame[8:-2] for frame in wires.instructions if frame[7] == WRITE]
    return [
        int.from_bytes(data[2:], "little", signed=True)
        for data in sent
        if data[:2] == address.to_bytes(2, "little") and len(data) == 2 + size
    ]


def test_every_file_of_the_sdk_belongs_to_a_model():
    assert len(NUMBERS) == 60
    assert len(REJECTED) == 14
    listed = {name.partition("_fw52")[0] for name in FILES} - {"dynamixel"}
    assert listed == set(model_numbers().values())
    assert {name: number for number, name in model_numbers().items() if name in NUMBERS} == NUMBERS


@pytest.mark.parametrize("file", [name for name in FILES if name != "dynamixel" and name not in REJECTED])
def test_servo_moves_by_the_counts_and_units_of_its_model(file):
    model, place = file.partition("_fw52")[0], places(file)
    series = next(row for start, row in SERIES.items() if model.startswith(start))
    assert load_config(None, [f"servo.model={model}"]).servo.model == model
    wires, servo = driven_on_a_wire(file)

    # Each register is where the file says.
    table = control_table(model, 52 if file.endswith("_fw52") else 44)
    assert {name: (r.address, r.size) for name, r in table.items() if name in place} == {
        name: at for name, at in place.items() if name in table
    }

    # A move by 90°.
    start, shaft_deg = servo.read_state(), wires.world.shaft()[0]
    profile = servo.set_profile(MotionProfile(60.0, 300.0))
    servo.torque_on()
    servo.move_to(start.position_deg + 90.0)
    units = round(60.0 / (series.rpm * 6)), round(300.0 / (series.rpm2 * 360 / 3600))
    assert (written(wires, place["Profile Velocity"]), written(wires, place["Profile Acceleration"])) == (
        [units[0]],
        [units[1]],
    )
    assert profile.velocity_dps == pytest.approx(units[0] * series.rpm * 6)
    assert profile.acceleration_dps2 == pytest.approx(units[1] * series.rpm2 / 10)
    first, *_, goal = written(wires, place["Goal Position"])
    assert goal - first == round(series.counts / 4)
    wires.world.clock.sleep(1.0)
    assert servo.read_state().velocity_dps == pytest.approx(profile.velocity_dps, abs=series.rpm * 6)
    wires.world.clock.sleep(3.0)
    end = servo.read_state()
    one = 360 / series.counts
    assert servo.resolution_deg == pytest.approx(one)
    assert end.position_deg - start.position_deg == pytest.approx(90.0, abs=one)
    assert wires.world.shaft()[0] - shaft_deg == pytest.approx(90.0, abs=one)
    assert end.in_position
    assert not end.moving
    assert servo.reach_deg == pytest.approx((-series.extended * one, series.extended * one))

    # The limits in its memory are respected, and read in its units.
    wires, servo = driven_on_a_wire(file)
    memory = wires.device.memory
    for limit in ("Velocity Limit", "Acceleration Limit"):
        if limit in place:
            memory[limit] //= 2
    servo.prepare(write=False)
    servo.set_profile(MotionProfile(1e6, 1e9))
    assert written(wires, place["Profile Velocity"]) == [memory["Velocity Limit"]]
    most = memory["Acceleration Limit"] if "Acceleration Limit" in place else 32_767  # e-manual, X series
    (acceleration,) = written(wires, place["Profile Acceleration"])
    assert acceleration == most
    memory["Temperature Limit"], memory["Min Voltage Limit"], memory["Max Voltage Limit"] = 61, 70, 130
    again = DynamixelServo(servo.bus, bus_id=1, model=servo.identity.model, clock=wires.world.clock, mode="pan")
    assert again.limits.temperature_c == 61.0
    assert again.limits.voltage_v == pytest.approx((7.0, 13.0))
    memory["Min Position Limit"], memory["Max Position Limit"] = 100, 1000
    assert again.reach_deg == pytest.approx((100 * servo.resolution_deg, 1000 * servo.resolution_deg))


@pytest.mark.parametrize("model", sorted(REJECTED))
def test_model_without_a_complete_row_is_rejected_by_its_name(model):
    missing = known_model(model).missing()
    assert missing
    assert not set(missing) & set(places(model))
    with pytest.raises(ConfigError) as caught:
        load_config(None, [f"servo.model={model}"])
    (mistake,) = caught.value.evidence["mistakes"]
    assert f"servo.model: the rig cannot drive this model: its row in the table of models lacks {missing[0]}" in mistake
    assert f"{USE_ANOTHER} (found '{model}')" in mistake
    with pytest.raises(ConfigError, match=f"cannot drive a {model}") as caught:  # no register has an address
        control_table(model)
    assert caught.value.evidence["missing"] == list(missing)
    assert set(caught.value.evidence["models"]) == set(model_numbers().values()) - REJECTED


def test_row_of_a_package_without_units_is_rejected_by_its_name(monkeypatch):
    row = DynamixelModel("bare", 4711, known_model("xl430_w250").registers)
    monkeypatch.setattr("rig.devices.dynamixel.registers.plugins", lambda _: [("bare", row)])
    with pytest.raises(ConfigError, match="cannot drive a bare") as caught:
        control_table("bare")
    units = [f"the unit of {name}" for name in ("Goal Position", "speed", "acceleration")]
    more = ["the range of Goal Position in extended position mode", "Acceleration Limit"]
    assert caught.value.evidence["missing"] == [*more, *units]


@pytest.mark.parametrize("number", [NUMBERS[model] for model in sorted(REJECTED)])
def test_servo_that_the_rig_cannot_drive_is_rejected_when_it_answers(number):
    wires = servo_wires()
    wires.device.memory["Model Number"] = number
    with pytest.raises(DeviceMismatch, match=r"cannot drive the servo at id 1 \(") as caught:
        DynamixelServo(open_bus(wires), bus_id=1, model="xl430_w250", clock=wires.world.clock)
    assert NUMBERS[caught.value.evidence["got"]] == number
    assert caught.value.evidence["reason"]
    assert "X series" in caught.value.next_step
    assert {frame[7] for frame in wires.instructions} == {1}  # ping


@pytest.mark.parametrize(("number", "name"), [(4000, "YM070-210-M001"), (350, "XL320"), (4711, "unknown model 4711")])
def test_scan_and_doctor_report_a_servo_that_the_rig_cannot_drive(number, name):
    with unopened() as bench:
        bench.devices.servo.memory["Model Number"] = number
        scan = DeviceScan()
        (found,) = scan.find_servos(bench.context)
        assert (found.code, str(found.evidence["found"]).partition(",")[0]) == ("servo_not_driven", name)
        assert "X series" in found.fix
        assert scan.settings == {}
        problem = bench.problem("servo")
        assert "cannot drive" in problem.evidence["what"]
        assert "X series" in problem.fix  # not `rig config set servo.model`
        bench.context.config = load_config(None, ["servo.id=9"])
        other = bench.problem("servo")
        assert (other.code, other.fix) == ("other_servos", found.fix)
