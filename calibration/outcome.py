"""The results of a bench's calibrations, in force or not, in words and as JSON."""

from typing import TYPE_CHECKING, Any

from rig.core.errors import UsageError
from rig.core.next_steps import Do
from rig.core.phrases import in_unit

if TYPE_CHECKING:
    from rig.bench import Bench
    from rig.calibrations import BenchCalibration, CalibrationResult, CalibrationStore


def stored_results(bench: "Bench") -> "tuple[CalibrationStore, list[BenchCalibration]]":
    """Return the store of the bench's results, and its calibrations with their status."""
    from rig.calibrations import CalibrationStore

    store = CalibrationStore(bench.config.calibration_path(bench.name))
    return store, store.on_bench(bench.apparatus(), bench.clock.utc())


def in_force(bench: "Bench", name: str) -> "CalibrationResult":
    """Return the result called ``name`` that is in force on the bench. Raises `UsageError` if there is none."""
    from rig.calibrations import CalibrationStatus

    for calibration in stored_results(bench)[1]:
        if calibration.result.name == name and calibration.status is CalibrationStatus.IN_FORCE:
            return calibration.result
    raise UsageError(f"{name} is not calibrated on this bench.", next_step=Do.CALIBRATE(name=name.partition(".")[0]))


def as_json(result: "CalibrationResult") -> dict[str, Any]:
    """Return a result as JSON; each rejection also in words, and each estimate with its standard uncertainty."""
    from rig.core.json_form import plain

    rejections = [{"code": r.code.name.lower(), "values": plain(r.values), "text": str(r)} for r in result.rejections]
    estimates = {name: {**plain(one), "uncertainty": one.uncertainty} for name, one in result.estimates.items()}
    return {**plain(result), "estimates": estimates, "rejections": rejections}


def outcome_text(result: "CalibrationResult") -> str:
    """Return the outcome of a calibration: its values, or the reasons why it did not pass and the next step."""
    residual = f" (worst residual {residual_words(result)})" if result.limit is not None else ""
    lines = [f"{'PASS' if result.passed else 'FAIL'} {result.name}{residual}"]
    lines += [f"  {name} = {estimate}" for name, estimate in result.estimates.items()]
    lines += [f"  sets {key} = {plain_value(value)}" for key, value in result.settings.items()]
    return "\n".join([*lines, *(f"  {rejection}" for rejection in result.rejections)])


def residual_words(result: "CalibrationResult") -> str:
    """Return the worst residual of the fit with its limit: "0.014°, limit 0.15°"; empty without one."""
    if result.residual is None:
        return ""
    limit = "" if result.limit is None else f", limit {in_unit(f'{result.limit:.3g}', result.residual_unit)}"
    return f"{in_unit(f'{result.residual:.3g}', result.residual_unit)}{limit}"


def plain_value(value: Any) -> str:
    """Return a value of the configuration in a few digits."""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
