"""The pytest plug-in in another project: in its own folder and its own process."""

import re
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

from tests.programs import Program

DOCUMENT = Path(__file__).parents[2] / "docs" / "how-to" / "test-without-hardware.md"


def project(folder: Path, code: str) -> list[str]:
    """Write the tests of another project; return the arguments of pytest."""
    (folder / "test_theirs.py").write_text(code, encoding="utf-8")
    (folder / "pytest.ini").write_text("[pytest]\naddopts = --strict-markers\n", encoding="utf-8")
    return ["-q", "-p", "no:cacheprovider", "test_theirs.py"]


def test_documented_tests_pass_in_another_project(tmp_path):
    (documented,) = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)
    code = (
        f"{documented}\n"
        "from sim.noise import NoiseModel\n"
        "@pytest.mark.sim('identify.max_views=3', seed=5, noise=NoiseModel.none())\n"
        "def test_marked(sim_bench, sim_world):\n"
        "    assert sim_bench.config.identify.max_views == 3\n"
        "    assert (sim_world.seed, sim_world.noise) == (5, NoiseModel.none())\n"
        "    assert sim_bench.clock is sim_world.clock\n"
        "def test_plain(sim_world):\n"
        "    assert (sim_world.seed, sim_world.noise) == (0, NoiseModel())\n"
    )
    words = project(tmp_path, code)
    program = Program(*words, code="import pytest; raise SystemExit(pytest.main())", folder=tmp_path)
    output, errors = program.communicate()
    assert program.returncode == 0, output + errors
    assert "4 passed" in output


def test_plugin_imports_nothing_heavy_without_its_fixtures(tmp_path):
    code = (
        "import sys\n"
        "def test_light(request):\n"
        "    assert request.config.pluginmanager.has_plugin('rig-sim')\n"
        "    assert not {'numpy', 'cv2', 'sqlalchemy', 'pydantic'} & set(sys.modules)\n"
    )
    others = {one.name for one in entry_points(group="pytest11")} - {"rig-sim"}  # whatever else is installed here
    words = project(tmp_path, code) + [word for name in sorted(others) for word in ("-p", f"no:{name}")]
    done = subprocess.run([sys.executable, "-m", "pytest", *words], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
