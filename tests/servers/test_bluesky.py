"""The bench in a real RunEngine: valid documents with provenance, stored and read back with Tiled."""

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event
from typing import Any

import pytest

pytest.importorskip("bluesky", reason="bluesky is not installed (make test-servers)")
pytestmark = pytest.mark.filterwarnings("ignore")  # of the packages of bluesky

import event_model  # noqa: E402
from bluesky import RunEngine, plan_stubs, plans, protocols  # noqa: E402
from bluesky.utils import FailedStatus, RunEngineInterrupted  # noqa: E402

from rig.bench import open_bench  # noqa: E402
from rig.bluesky import BenchDevices, enroll, identify  # noqa: E402
from rig.catalog import Catalog  # noqa: E402
from rig.config import load_config  # noqa: E402
from rig.core.errors import MotionStopped  # noqa: E402
from rig.devices.servo import ServoState  # noqa: E402
from rig.safety.supervisor import TableState  # noqa: E402
from rig.search.model import load_model  # noqa: E402
from tests.rig.plans.test_fly import flying  # noqa: E402

Documents = list[tuple[str, dict[str, Any]]]


@pytest.fixture
def devices(tmp_path: Path) -> Iterator[BenchDevices]:
    config = load_config(None, [f'state_dir="{tmp_path / "state"}"'], search=False)
    with open_bench("sim", config, seed=3) as bench:
        yield BenchDevices(bench, hold=False)


def validated(documents: Documents) -> dict[str, int]:
    counts: dict[str, int] = {}
    for name, document in documents:
        event_model.schema_validators[event_model.DocumentNames[name]].validate(document)
        counts[name] = counts.get(name, 0) + 1
    return counts


@contextmanager
def tiled_server(folder: Path) -> Iterator[str]:
    """Yield the address of a Tiled server with an SQLite catalog of its own."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "tiled", "serve", "catalog", "--temp", "--api-key", "secret", "--port", str(port)]
    with (folder / "tiled.log").open("w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log, cwd=folder)
    try:
        for _ in range(600):
            with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
                break
            with suppress(subprocess.TimeoutExpired):
                process.wait(0.1)
                raise AssertionError((folder / "tiled.log").read_text())
        yield f"http://127.0.0.1:{port}/api/v1"
    finally:
        process.kill()
        process.wait()


def test_devices_have_the_protocols_and_scan(devices: BenchDevices) -> None:
    devices._hold = True
    assert isinstance(devices.table, protocols.Movable)
    assert isinstance(devices.table, protocols.Stoppable)
    assert isinstance(devices.camera, protocols.Readable)
    assert isinstance(devices.camera, protocols.Triggerable)
    assert isinstance(devices.imu, protocols.Triggerable)
    documents: Documents = []
    with devices:
        devices.bench.placer.place("toy-house")
        engine = RunEngine({}, context_managers=[])
        engine.subscribe(lambda name, document: documents.append((name, document)))
        engine(plans.scan([devices.camera, devices.imu], devices.table, 0, 90, 3, md=devices.provenance()))
    counts = validated([one for one in documents if one[0] != "event"])
    assert counts == {"start": 1, "descriptor": 1, "stop": 1}
    events = [document for name, document in documents if name == "event"]
    assert [round(event["data"]["table_encoder_deg"]) for event in events] == [0, 45, 90]
    assert all(event["data"]["camera_accepted"] for event in events)
    assert documents[0][1]["bench"] == "sim"


@pytest.mark.parametrize("asked_by", ["device", "engine"])
def test_stop_ends_a_rotation_with_the_torque_off_and_the_next_run_works(devices: BenchDevices, asked_by: str) -> None:
    devices._hold = True
    documents: Documents = []
    engine = RunEngine({}, context_managers=[])
    engine.subscribe(lambda name, document: documents.append((name, document)))
    bench = devices.bench
    readings: list[float] = []

    def stop_in_motion(state: ServoState) -> None:
        readings.append(state.position_deg)
        if max(readings) - min(readings) > 20 and not bench.state.stop_requested():
            if asked_by == "device":
                devices.table.stop()
            else:  # as Ctrl+C twice: the engine stops every device that moves
                engine.request_pause(defer=False)
                while not bench.state.stop_requested():
                    Event().wait(0.01)

    with devices:
        bench.safety.observers.append(stop_in_motion)
        expected = FailedStatus if asked_by == "device" else RunEngineInterrupted
        with pytest.raises(expected) as error:
            engine(plans.scan([devices.imu], devices.table, 0, 180, 2))
        if asked_by == "device":
            assert isinstance(error.value.__cause__ or error.value.args[0].exception(), MotionStopped)
        else:
            with suppress(FailedStatus):  # the failure of the move can arrive before the engine expects it
                engine.abort()
        devices.run(lambda: bench.safety.observers.remove(stop_in_motion))  # after the end of the motion
        assert 20 < max(readings) - min(readings) < 120
        assert bench.safety.state is TableState.STOPPED
    assert documents[-1][1]["exit_status"] in ("fail", "abort")
    documents.clear()
    with BenchDevices(bench) as again:
        engine(plans.scan([again.imu], again.table, 0, 30, 2))
    assert documents[-1][1]["exit_status"] == "success"


def test_plans_enroll_and_identify_and_tiled_reads_them_back(devices: BenchDevices, tmp_path: Path) -> None:
    from bluesky_tiled_plugins import TiledWriter
    from tiled.client import from_uri

    documents: Documents = []
    with (
        tiled_server(tmp_path) as uri,
        devices,
        Catalog.open(tmp_path / "catalog", clock=devices.bench.clock) as c,
    ):
        client = from_uri(uri, api_key="secret")
        engine = RunEngine({}, context_managers=[])
        engine.subscribe(lambda name, document: documents.append((name, document)))
        engine.subscribe(TiledWriter(client))
        engine(enroll(devices, c, "toy-house", views=8))
        engine(enroll(devices, c, "toy-car", views=8))
        assert {one.name: one.views for one in c.objects()} == {"toy-house": 8, "toy-car": 8}
        (uid,) = engine(identify(devices, load_model(c)))
        counts = validated(documents)
        assert counts["start"] == counts["stop"] == 3
        answer = next(d for n, d in documents if n == "event" and "answer_object" in d["data"])
        assert answer["data"]["answer_outcome"] in ("found", "ambiguous", "unknown")
        run = client[uid]
        assert run.metadata["start"]["bench"] == "sim"
        assert run.metadata["start"]["plan_name"] == "rig_identify"
        assert run.metadata["stop"]["exit_status"] == "success"
        client.context.http_client.close()


def test_plan_enrolls_in_one_revolution(tmp_path: Path) -> None:
    documents: Documents = []
    with flying(tmp_path) as (bench, catalog, _), BenchDevices(bench, hold=False) as devices:
        engine = RunEngine({}, context_managers=[])
        engine.subscribe(lambda name, document: documents.append((name, document)))
        engine(enroll(devices, catalog, "block", views=12, fly=True))
        assert catalog.object("block").summary.views == 12
    validated(documents)
    assert sum(len(d["seq_num"]) if n == "event_page" else n == "event" for n, d in documents) == 12
    assert documents[-1][1]["exit_status"] == "success"


def test_abort_ends_the_plan_and_switches_the_torque_off(devices: BenchDevices, tmp_path: Path) -> None:
    with devices, Catalog.open(tmp_path / "catalog", clock=devices.bench.clock) as catalog:
        engine = RunEngine({}, context_managers=[])

        def broken() -> Any:
            plan = enroll(devices, catalog, "toy-house", views=8)
            for number, message in enumerate(plan):
                if number == 8:
                    plan.close()
                    break
                yield message
            yield from plan_stubs.null()

        engine(broken())
        (left,) = catalog.objects()
        assert left.unfinished_views  # they stay, and the bench is free for the next plan
        engine(enroll(devices, catalog, "toy-house", resume=True))
        assert catalog.object("toy-house").summary.views == 8
