import subprocess
import sys


def test_importing_retrieval_loads_neither_scipy_nor_the_controller() -> None:
    code = "import sys, hbr; print(sorted({'scipy', 'rig', 'sim', 'sqlalchemy', 'serial'} & set(sys.modules)))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
