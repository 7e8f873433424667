"""The models of the SDK: the rig accepts those that its driver drives rightly, and rejects the others by name.

The `.model` files of the SDK are read here once more, and compared with what the driver does.
"""

from importlib.resources import files
from math import degrees

import pytest

from rig.config import load_config
from rig.core.errors import ConfigError, DeviceMismatch
from rig.devices.dynamixel.registers import control_table
from rig.devices.dynamixel.servo import DEG_PER_COUNT, DPS_PER_UNIT, DynamixelServo
from rig.doctor.device_scan import DeviceScan
from rig.doctor.finding import FindingCode
from tests.rig.bench_parts import open_bus, servo_wires
from tests.rig.doctor.doctor_parts import unopened

FOLDER = files("dynamixel_easy_sdk") / "control_table"
NUMBERS = {
    name.removesuffix(".model"): int(number)
    for number, name in (line.split() for line in (FOLDER / "dynamixel.model").read_text().splitlines()[1:])
}
REJECTED = {name for name in NUMBERS if name == "xl320" or not name.startswith(("x", "2x", "mx"))}
# Address and size of the registers that the driver uses, from the e-manual of the XL430-W250.
REGISTERS = {
    "Model Number": (0, 2),
    "Firmware Version": (6, 1),
    "ID": (7, 1),
    "Baud Rate": (8, 1),
    "Return Delay Time": (9, 1),
    "Drive Mode": (10, 1),
    "Operating Mode": (11, 1),
    "Homing Offset": (20, 4),
    "Temperature Limit": (31, 1),
    "Max Voltage Limit": (32, 2),
    "Min Voltage Limit": (34, 2),
    "Velocity Limit": (44, 4),
    "Shutdown": (63, 1),
    "Torque Enable": (64, 1),
    "Status Return Level": (68, 1),
    "Hardware Error Status": (70, 1),
    "Goal Velocity": (104, 4),
    "Profile Acceleration": (108, 4),
    "Profile Velocity": (112, 4),
    "Goal Position": (116, 4),
    "Realtime Tick": (120, 2),
    "Moving": (122, 1),
    "Moving Status": (123, 1),
    "Present Velocity": (128, 4),
    "Present Position": (132, 4),
    "Position Trajectory": (140, 4),
    "Present Input Voltage": (144, 2),
    "Present Temperature": (146, 1),
}
OTHER_NAMES = {"Secondary ID": (12, 1), "Bus Watchdog": (98, 1)}  # the files write these names differently
FIRMWARE = (45, 52)


def model_file(file: str) -> dict[str, dict[str, str]]:
    """Return the sections of a `.model` file: the last value of each row by its name, for registers the place."""
    sections: dict[str, dict[str, str]] = {}
    for line in (FOLDER / file).read_text().splitlines():
        row = line.split("\t")
        if line.startswith("["):
            here = sections.setdefault(line.strip("[]"), {})
        elif line and row[0] not in {"name", "Data Name", "Address"}:
            here.update({row[2]: f"{row[0]} {row[1]}"} if row[0].isdigit() else {row[0]: row[1]})
    return sections


def drives_rightly(model: str) -> bool:
    """Return whether the driver's 90° are 90° of this model, its speeds are the driver's, and so are its registers."""
    for file in (f"{model}.model", f"{model}_fw52.model"):
        if not (FOLDER / file).is_file():
            continue
        found = model_file(file)
        kind = {name: float(value) for name, value in found["type info"].items()}
        deg_per_count = degrees(kind["max_radian"] - kind["min_radian"]) / (
            kind["value_of_max_radian_position"] - kind["value_of_min_radian_position"]
        )
        dps_per_unit = degrees(float(found["unit info"]["Goal Velocity"]))
        places = found["control table"]
        rotated_deg = round(90 / DEG_PER_COUNT) * deg_per_count
        load = places.get("Present Load") or (places.get("Present Current") if "Current Limit" in places else None)
        if not (
            rotated_deg == pytest.approx(90, abs=0.1)
            and dps_per_unit == pytest.approx(DPS_PER_UNIT, rel=1e-3)
            and load == "126 2"
            and all(places.get(name) == f"{at} {size}" for name, (at, size) in REGISTERS.items())
        ):
            return False
    return True


def test_all_models_of_the_sdk_are_in_the_list():
    assert len(NUMBERS) == 60  # and the AX-12A, which has no file
    assert len(REJECTED) == 26


@pytest.mark.parametrize("model", [*NUMBERS, "ax_12a"])
def test_model_is_accepted_only_if_it_is_driven_rightly(model):
    if model == "ax_12a" or model not in REJECTED:
        assert model == "ax_12a" or drives_rightly(model)
        assert load_config(None, [f"servo.model={model}"]).servo.model == model
        for firmware in FIRMWARE if model != "ax_12a" else ():
            table = control_table(model, firmware)
            used = REGISTERS | OTHER_NAMES
            assert {name: (table[name].address, table[name].size) for name in used} == used
        return
    assert not drives_rightly(model)
    with pytest.raises(ConfigError) as caught:
        load_config(None, [f"servo.model={model}"])
    (mistake,) = caught.value.evidence["mistakes"]
    assert "servo.model: the rig cannot drive this model" in mistake
    assert f"Use a servo of the X series or the MX series (2.0), or an AX-12A (found '{model}')" in mistake
    with pytest.raises(ConfigError, match=f"cannot drive a {model}"):  # the second lock: no register has an address
        control_table(model)


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


@pytest.mark.parametrize(("number", "name"), [(2010, "PH54-100-S500"), (350, "XL320"), (4711, "unknown model 4711")])
def test_scan_and_doctor_report_a_servo_that_the_rig_cannot_drive(number, name):
    with unopened() as bench:
        bench.devices.servo.memory["Model Number"] = number
        scan = DeviceScan()
        (found,) = (one for one in scan.find_servos(bench.context) if not isinstance(one, str))
        assert (found.code, str(found.parameters["found"]).partition(",")[0]) == (FindingCode.SERVO_NOT_DRIVEN, name)
        assert "X series" in found.fix
        assert scan.settings == {}
        problem = bench.problem("servo")
        assert "cannot drive" in problem.parameters["what"]
        assert "X series" in problem.fix  # not `rig config set servo.model`
        bench.context.config = load_config(None, ["servo.id=9"])
        other = bench.problem("servo")
        assert (other.code, other.fix) == (FindingCode.OTHER_SERVOS, found.fix)
