"""The meaning of a servo's registers, with the units of the e-manual."""

from rig.config.servos import DynamixelModel
from rig.core.phrases import angle_words, filled, number
from rig.devices.dynamixel.registers import ControlTable
from rig.devices.dynamixel.servo import hardware_errors

BAUD_CODES = {9_600: 0, 57_600: 1, 115_200: 2, 1_000_000: 3, 2_000_000: 4, 3_000_000: 5, 4_000_000: 6, 4_500_000: 7}
"""Values of Baud Rate, Protocol 2.0."""
AX_BAUD = 2_000_000  # protocol 1.0: the value of Baud Rate is this number divided by the rate, minus one

# All values and bits: e-manual, control tables of the X series and the AX-12A.
_OPERATING_MODES = {
    0: "current",
    1: "velocity",
    3: "position, within one revolution",
    4: "extended position, many revolutions",
    5: "current-based position",
    16: "PWM",
}
_DRIVE_BITS = ((0x01, "reversed direction"), (0x04, "time-based profile"), (0x08, "torque on by goal"))
_STARTUP_BITS = ((0x01, "torque on at power-up"), (0x02, "RAM restored at power-up"))
_RETURN_LEVELS = {0: "answers to ping only", 1: "answers to ping and read", 2: "answers to everything"}
_AX_ERRORS = ("input voltage", "angle limit", "overheating", "range", "checksum", "overload", "instruction")

_SCALED: dict[str, tuple[float | str, str]] = {
    "Return Delay Time": (2, "{:g} µs"),
    "Realtime Tick": (1, "{:g} ms"),
    **dict.fromkeys(("Temperature Limit", "Present Temperature"), ("c_per_unit", "{:g} °C")),
    **dict.fromkeys(("Max Voltage Limit", "Min Voltage Limit"), ("v_per_unit", "{:.1f} V")),
    **dict.fromkeys(("Present Input Voltage", "Present Voltage"), ("v_per_unit", "{:.1f} V")),
    **dict.fromkeys(("PWM Limit", "Goal PWM", "Present PWM"), ("pwm_percent_per_unit", "{:.1f} %")),
}
"""Registers that count in a unit: its size or its name in the model's row, and the template of the value."""

_SWITCHES = {"Torque Enable", "LED", "Moving", "Registered Instruction", "Backup Ready", "Lock", "Registered"}
_DEGREES = {
    *("Homing Offset", "Max Position Limit", "Min Position Limit", "Goal Position", "Present Position"),
    *("Position Trajectory", "CW Angle Limit", "CCW Angle Limit"),
}
_VELOCITIES = {
    *("Moving Threshold", "Velocity Limit", "Goal Velocity", "Profile Velocity", "Present Velocity"),
    "Velocity Trajectory",
}
_CURRENTS = {"Current Limit", "Goal Current", "Present Current"}


def baud_codes(table: ControlTable) -> dict[int, int]:
    """Return the baud rates that a model can be set to, each with its register value."""
    if table.row.protocol == 1:
        return {
            rate: round(AX_BAUD / rate) - 1
            for rate in (9_600, 19_200, 57_600, 115_200, 200_000, 250_000, 500_000, 1_000_000)
        }
    fastest = 4_000_000 if table.row.name.startswith(("xl330", "xc330")) else 4_500_000
    return {rate: code for rate, code in BAUD_CODES.items() if rate <= fastest}


def meaning(table: ControlTable, name: str, value: int) -> str:
    """Return the meaning of a register's value; empty if the number needs none."""
    row = table.row
    if name in _SCALED:
        unit, template = _SCALED[name]
        return filled(template, value * (getattr(row, unit) if isinstance(unit, str) else unit))
    if name in _SWITCHES:
        return "on" if value else "off"
    if name == "Status Return Level":
        return _RETURN_LEVELS.get(value, "unknown level")
    if row.protocol == 1:
        return _ax_meaning(row, name, value)
    match name:
        case "Baud Rate":
            return next((f"{rate} bit/s" for rate, code in BAUD_CODES.items() if code == value), "unknown rate")
        case "Drive Mode":
            return _bits(value, _DRIVE_BITS, "normal direction, velocity-based profile")
        case "Operating Mode":
            return _OPERATING_MODES.get(value, "unknown mode")
        case "Secondary ID":
            return "off" if value > 252 else "obeys this id, too"
        case "Protocol Type":
            return f"protocol {value}.0"
        case "Startup Configuration":
            return _bits(value, _STARTUP_BITS, "nothing at power-up")
        case "Shutdown":
            return ", ".join(hardware_errors(value)) or "nothing takes the torque away"
        case "Hardware Error Status":
            return ", ".join(hardware_errors(value)) or "none"
        case "Bus Watchdog":
            return "off" if value == 0 else "tripped" if value in (0xFF, -1) else f"{20 * value} ms"
        case "Profile Acceleration":
            return "as fast as it can" if value == 0 else f"{value * row.dps2_per_unit:.1f} °/s²"
        case "Profile Velocity" if value == 0:
            return "as fast as it can"
        case "Moving Status":
            return "arrived" if value & 1 else "not arrived"
        case "Present Load":
            return f"{number(value * row.load_percent_per_unit, '.1f')} %"
    if name in _DEGREES:
        return angle_words(value * row.deg_per_count, 2)
    if name in _VELOCITIES:
        return f"{number(value * row.dps_per_unit, '.2f')} °/s"
    return f"{number(value * row.ma_per_unit, '.0f')} mA" if name in _CURRENTS else ""


def _ax_meaning(row: DynamixelModel, name: str, value: int) -> str:
    match name:
        case "Baud Rate":
            return f"{AX_BAUD / (value + 1):.0f} bit/s"
        case "Max Torque" | "Torque Limit":
            return f"{value / 10.23:.0f} %"
        case "Alarm LED" | "Shutdown":
            return ", ".join(text for bit, text in enumerate(_AX_ERRORS) if value >> bit & 1) or "nothing"
        case "Moving Speed" if value == 0:
            return "as fast as it can"
        case "Moving Speed" | "Present Speed":
            return f"{(value & 0x3FF) * row.dps_per_unit:.1f} °/s{' clockwise' if value & 0x400 else ''}"
        case "Present Load":
            return f"{(value & 0x3FF) / 10.23:.0f} %{' clockwise' if value & 0x400 else ''}"
    return f"{value * row.deg_per_count:.1f}°" if name in _DEGREES else ""


def _bits(value: int, names: tuple[tuple[int, str], ...], none: str) -> str:
    return ", ".join(text for bit, text in names if value & bit) or none
