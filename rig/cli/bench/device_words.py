"""The devices of `rig status` in words, from its report."""

from collections.abc import Callable, Mapping
from typing import Any, Final

from rig.core.phrases import filled
from rig.devices.camera import CameraLocks
from rig.doctor.camera import lock_words


def device_lines(device: str, values: Mapping[str, Any]) -> list[str]:
    """Return lines about a device: what it is, then its state; or its error."""
    if error := values.get("error"):
        return [f"error {error['code']}: {error['what']} {error['next_step']}"]
    return _LINES[device](values)


def _servo(values: Mapping[str, Any]) -> list[str]:
    model = values["model"].replace("_", "-").upper()
    motion = filled("moving at {:.0f} °/s", values["velocity_dps"]) if values["moving"] else "at rest"
    state = "shaft at {:.1f}°, {}, load {:.0f} %, {:.1f} V, {:.0f} °C, hardware errors: {}"
    keys = ("load_percent", "voltage_v", "temperature_c")
    errors = ", ".join(values["hardware_errors"]) or "none"
    return [
        f"{model}, id {values['bus_id']}, firmware {values['firmware']}",
        filled(state, values["position_deg"], motion, *(values[key] for key in keys), errors),
        f"bus: {_counts(values['bus'])}",
    ]


def _imu(values: Mapping[str, Any]) -> list[str]:
    return [
        filled("{} at address 0x{:02x}, {:.0f} °C", values["model"], values["bus_address"], values["temperature_c"])
    ]


def _head(values: Mapping[str, Any]) -> list[str]:
    state = (
        f"state {values['state']}",
        f"faults: {', '.join(values['faults']) or 'none'}",
        f"emergency stop {'pressed or unplugged' if values['estop_open'] else 'released'}",
        f"servo supply {'on' if values['relay_closed'] else 'off'}",
        f"sensor {values['sensor']}",
    )
    timing = "clock drift {:.1f} ppm, time uncertainty {:.1f} µs"
    counts = dict(values["connection"])
    timed = filled(timing, counts.pop("drift_ppm"), counts.pop("time_uncertainty_us"))
    return [", ".join(state), f"connection: {_counts(counts)}, {timed}"]


def _camera(values: Mapping[str, Any]) -> list[str]:
    device = f" ({values['device']})" if values["device"] else ""
    mode = filled("{}x{} at {:.3g} frames/s", values["width"], values["height"], values["fps"])
    locks = [f"{name} {value}" for name, value in lock_words(CameraLocks(**values["locks"])).items()]
    return [f"{values['name']}{device}, {mode}", *([", ".join(locks)] if locks else [])]


def _counts(counts: Mapping[str, int]) -> str:
    """Return the counts that are not 0: "19 transactions, 2 timeouts"."""
    found = [f"{count} {name.replace('_', ' ')}" for name, count in counts.items() if count]
    return ", ".join(found) or "no traffic yet"


_LINES: Final[dict[str, Callable[[Mapping[str, Any]], list[str]]]] = {
    "servo": _servo,
    "imu": _imu,
    "head": _head,
    "camera": _camera,
}
