"""Drive the bench with bluesky (extra `bluesky`): a scan of the table, and enroll and identify as plans.

The documents of each run have the provenance of the bench. To store them, subscribe a writer, such as
`bluesky_tiled_plugins.TiledWriter`.
"""

import sys
import tempfile
from typing import Any

from rig import Catalog, load_model, open_bench


def main() -> None:
    try:
        from bluesky import RunEngine, plans
    except ImportError:
        sys.exit("This example needs bluesky. Install it: pip install 'hbr-rig[bluesky]'")
    from rig.bluesky import BenchDevices, enroll, identify

    def show(name: str, document: dict[str, Any]) -> None:
        if name == "event":
            print({key: value for key, value in document["data"].items() if not key.endswith("image")})

    engine = RunEngine({}, context_managers=[])
    engine.subscribe(show)
    with (
        tempfile.TemporaryDirectory() as folder,
        open_bench("sim", seed=3) as bench,
        Catalog.open(folder, clock=bench.clock) as catalog,
    ):
        with BenchDevices(bench, hold=False) as devices:  # the plans prepare the table themselves
            for name in ("toy-house", "toy-car"):
                engine(enroll(devices, catalog, name, views=8))
            engine(identify(devices, load_model(catalog)))
        with BenchDevices(bench) as devices:
            engine(plans.scan([devices.camera, devices.imu], devices.table, 0, 90, 3, md=devices.provenance()))


if __name__ == "__main__":
    main()
