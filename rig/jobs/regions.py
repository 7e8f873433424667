"""Whether the objects of this bench were enrolled with the region of interest that it uses now."""

from collections.abc import Iterable, Iterator
from typing import Any

from rig.bench import Bench
from rig.calibrations import CalibrationStore
from rig.calibrations.store import CALIBRATIONS
from rig.catalog import Catalog
from rig.catalog.derived import described_regions
from rig.core.next_steps import Do
from rig.jobs.desk import Remark


def warn_of_other_regions(bench: Bench, catalog: Catalog) -> Iterator[Remark]:
    """Yield a remark if objects were enrolled with another region of the images than the bench uses now.

    Two regions that both follow from a calibration of the axis show the same part of an object. They are not reported.
    """
    known = CalibrationStore(bench.config.calibration_path(bench.name)).history("table.axis")
    calibrated = {(one.id, tuple(one.settings["view.roi"])) for one in known if "view.roi" in one.settings}

    def is_calibrated(region: Any, calibrations: Iterable[str]) -> bool:
        return any((id_, region) in calibrated for id_ in calibrations)

    region = bench.config.view.roi
    calibrated_now = is_calibrated(region, bench.conditions.get(CALIBRATIONS, ()))
    others = {
        other
        for other, calibrations in described_regions(catalog, bench.name)
        if other != region and not (calibrated_now and is_calibrated(other, calibrations))
    }
    if others:
        words = sorted("the whole image" if other is None else str(list(other)) for other in others)
        back = "REGION" if len(others) > 1 else "none" if None in others else words[0]
        yield Remark(
            f"objects of this bench were enrolled with view.roi = {' and '.join(words)}; now it is "
            f"{'the whole image' if region is None else list(region)}"
            f"{' (axis calibration)' if calibrated_now else ''}.",
            steps=(
                "If the camera was not moved,",
                Do.SET_KEY(key="view.roi", value=back),
                "If it was moved,",
                Do.ENROLL_AGAIN(),
            ),
        )
