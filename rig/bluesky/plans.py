"""Enroll and identify as plans for a RunEngine. The start documents have the provenance that the catalog stores."""

from collections.abc import Generator
from typing import Any

from rig.bluesky.devices import BenchDevices, Device, Steps
from rig.catalog import Catalog
from rig.core.errors import ExtraMissing
from rig.events.events import Identified
from rig.plans.enroll import enroll as enroll_steps
from rig.plans.identify import identify as identify_steps
from rig.search.model import Model

try:
    from bluesky import plan_stubs
except ImportError as error:
    raise ExtraMissing.of("bluesky", "plans for bluesky", error) from error

Plan = Generator[Any, Any, Any]


def enroll(
    devices: BenchDevices, catalog: Catalog, object_name: str, *, md: dict[str, Any] | None = None, **options: Any
) -> Plan:
    """Enroll an object in one run with an event for each view; ``options`` as for `rig.plans.enroll.enroll`."""
    steps = Steps(devices, "view", enroll_steps(devices.bench, catalog, object_name, **options))
    start = {"plan_name": "rig_enroll", "object": object_name, "catalog": str(catalog.place)}
    return (yield from _run(devices, steps, {**start, **(md or {})}))


def identify(devices: BenchDevices, model: Model, *, md: dict[str, Any] | None = None, **options: Any) -> Plan:
    """Identify the object on the table in one run; the stream ``answer`` has the answer, which is also returned.

    ``options`` as for `rig.plans.identify.identify`.
    """
    steps = Steps(devices, "view", identify_steps(devices.bench, model, **options))
    return (yield from _run(devices, steps, {"plan_name": "rig_identify", **(md or {})}))


def _run(devices: BenchDevices, steps: Steps, start: dict[str, Any]) -> Plan:
    yield from plan_stubs.open_run({**devices.provenance(), **start})
    try:
        while True:
            yield from plan_stubs.trigger(steps, wait=True)
            if steps.finished:
                break
            yield from plan_stubs.create("primary")
            yield from plan_stubs.read(steps)
            yield from plan_stubs.save()
        if isinstance(steps.last, Identified):
            yield from plan_stubs.create("answer")
            yield from plan_stubs.read(_Answer(devices, steps.last))
            yield from plan_stubs.save()
        yield from plan_stubs.close_run()
    finally:
        steps.close()
    return steps.last


class _Answer(Device):
    def __init__(self, devices: BenchDevices, answer: Identified) -> None:
        super().__init__(devices, "answer")
        rotation = float("nan") if answer.yaw_deg is None else float(answer.yaw_deg)
        self._read(
            {
                "outcome": answer.outcome.value,
                "object": answer.name or "",
                "score": float(answer.score),
                "rotation_deg": rotation,
                "views": int(answer.views),
            }
        )
