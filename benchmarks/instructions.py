"""Count the instructions of a step, from the view to the decision, on the processors of small computers.

Debian's Python, NumPy and OpenCV for arm64 and armhf run in the user-mode emulator, with the kernels compiled for
them. A plugin of the emulator counts the instructions of the whole process. A part is counted by two runs with
different numbers of repetitions, so that the start and the preparation cancel out.

Needs Debian 12, its packages qemu-user, gcc, gcc-aarch64-linux-gnu and gcc-arm-linux-gnueabihf, and 2.2 GB of disk.
No root: Debian's packages for the other processors are unpacked into a folder.
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, NamedTuple

REPOSITORY: Final = Path(__file__).resolve().parent.parent
PLUGIN: Final = REPOSITORY / "benchmarks" / "instructions.c"
PACKAGES: Final = ("python3-numpy", "python3-scipy", "python3-opencv")
OBJECTS: Final = 100
#: The views of a search before the one that is counted, as positions on an object's ring of 72 views.
SEEN: Final = (0, 18, 30, 45, 60, 66, 9)
#: Different views for the repetitions, so that no search is remembered.
REPETITIONS: Final = 8


class Processor(NamedTuple):
    """A kind of processor: Debian's name, the emulator, and the name of its compiler and libraries."""

    debian: str
    emulator: str
    triplet: str


PROCESSORS: Final = (
    Processor("arm64", "qemu-aarch64", "aarch64-linux-gnu"),
    Processor("armhf", "qemu-arm", "arm-linux-gnueabihf"),
)


# --- What is counted. This part runs in the emulator. --------------------------------------------------------------


def _cedd() -> Callable[[int], object]:
    from benchmarks.bench_cedd import frame
    from hbr import cedd

    image = frame(640, 480)
    return lambda _: cedd(image)


def _ahbr() -> Callable[[int], object]:
    import numpy as np

    from benchmarks.bench_search import model, queries_of
    from hbr import ViewIndex, next_view, retrieve

    views = model(OBJECTS)
    index = ViewIndex(views)
    seen = queries_of(views, views.of(0)[list(SEEN)], 0)
    angles_deg = views.azimuth_deg[list(SEEN)]
    newest = np.arange(REPETITIONS + 1) * 5 + 20
    others = queries_of(views, views.of(0)[newest], 1)

    def step(i: int) -> object:
        queries = np.concatenate([seen, others[i : i + 1]])
        return next_view(retrieve(queries, np.append(angles_deg, views.azimuth_deg[newest[i]]), index))

    retrieve(seen, angles_deg, index)  # the views before the newest are searched for only once
    return step


def _segmented() -> Callable[[int], object]:
    from benchmarks.bench_views import frames
    from hbr import Background, descriptor, segment

    (image, *_), empty = frames(0)
    background, kind = Background(empty), descriptor("edges+colours+cedd")
    return lambda _: kind.describe(segment(image, empty_table=background))


def _dense() -> Callable[[int], object]:
    from benchmarks.bench_dense import of_kind
    from benchmarks.bench_search import model
    from hbr import DenseIndex, next_best_view, update_belief
    from hbr.dense.filter import Belief

    views = of_kind(model(OBJECTS), "edges+colours+cedd")
    belief: DenseIndex | Belief = DenseIndex(views)
    for row in SEEN:
        belief = update_belief(views.descriptors[row], float(views.azimuth_deg[row]), belief)

    def step(i: int) -> object:
        row = 20 + 5 * i
        return next_best_view(update_belief(views.descriptors[row], float(views.azimuth_deg[row]), belief))

    return step


PARTS: Final[dict[str, Callable[[], Callable[[int], object]]]] = {
    "CEDD of a frame, 640 x 480": _cedd,
    "HBR and AHBR, 8th view of 7,200": _ahbr,
    "object found, described by edges+colours+cedd": _segmented,
    "dense filter and next best view, 8th view of 7,200": _dense,
}


def repeat(part: str, times: int) -> None:
    """Prepare a part, run it once, and then so many times."""
    import cv2

    if not hasattr(cv2, "typing"):  # Debian's OpenCV is older than the names of its types, and computes the same
        vars(cv2)["typing"] = SimpleNamespace(MatLike=Any)
    cv2.setNumThreads(1)
    work = PARTS[part]()
    for i in range(times + 1):
        work(i)


# --- The counting. This part runs on the computer. -----------------------------------------------------------------


def unpacked(processor: Processor, folder: Path) -> Path:
    """Return a folder with Debian's Python and libraries for a processor; fetch it if it is not there."""
    root, apt = folder / processor.debian / "root", folder / processor.debian / "apt"
    if root.exists():
        return root
    for part in ("state/lists/partial", "cache/archives/partial", "etc/apt.conf.d", "etc/preferences.d"):
        (apt / part).mkdir(parents=True, exist_ok=True)
    (apt / "status").touch()
    keys = "/usr/share/keyrings/debian-archive-keyring.gpg"
    source = f"deb [signed-by={keys}] http://deb.debian.org/debian bookworm main\n"
    (apt / "etc" / "sources.list").write_text(source, encoding="ascii")
    settings = {
        "Dir::State": apt / "state",
        "Dir::State::status": apt / "status",
        "Dir::Cache": apt / "cache",
        "Dir::Etc": apt / "etc",
        "APT::Architecture": processor.debian,
        "APT::Architectures::": processor.debian,
    }
    command = ["apt-get", "-q", *(word for key, value in settings.items() for word in ("-o", f"{key}={value}"))]
    subprocess.run([*command, "update"], check=True, stdout=sys.stderr)
    download = ("-y", "--no-install-recommends", "--download-only", "install")
    subprocess.run([*command, *download, *PACKAGES], check=True, stdout=sys.stderr)
    unfinished = root.with_name("unfinished")
    for package in sorted((apt / "cache" / "archives").glob("*.deb")):
        subprocess.run(["dpkg-deb", "-x", package, unfinished], check=True)
    unfinished.rename(root)
    return root


def sources_for(processor: Processor, folder: Path) -> Path:
    """Return a copy of the sources with the kernels compiled for a processor."""
    copy = folder / processor.debian / "sources"
    subprocess.run(["rm", "-rf", copy], check=True)
    copy.mkdir(parents=True)
    subprocess.run(["cp", "-r", REPOSITORY / "hbr", REPOSITORY / "benchmarks", copy], check=True)
    (copy / "hbr" / "kernels" / "_kernels.so").unlink(missing_ok=True)
    compiler = {**os.environ, "CC": f"{processor.triplet}-gcc"}
    subprocess.run([sys.executable, "hbr/kernels/compile.py"], cwd=copy, env=compiler, check=True, stdout=sys.stderr)
    return copy


def count(processor: Processor, folder: Path, plugin: Path, part: str, times: int) -> int:
    """Return the instructions of a process that repeats a part; RuntimeError if it fails."""
    root = unpacked(processor, folder)
    libraries = root / "usr" / "lib" / processor.triplet
    variables = {
        "LD_LIBRARY_PATH": f"{libraries / 'blas'}:{libraries / 'lapack'}",
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONHASHSEED": "0",
        "OMP_NUM_THREADS": "1",
    }
    emulated: list[str | Path] = [processor.emulator, "-L", root, "-plugin", plugin]
    emulated += [word for key, value in variables.items() for word in ("-E", f"{key}={value}")]
    program = (root / "usr/bin/python3.11", "-m", "benchmarks.instructions", "--part", part, "--times", str(times))
    sources = folder / processor.debian / "sources"
    done = subprocess.run([*emulated, *program], cwd=sources, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{processor.emulator} ended with {done.returncode}: {done.stderr}")
    return int(done.stderr.split()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("emulated"), help="Where Debian's packages are unpacked.")
    parser.add_argument("--part", choices=PARTS, help=argparse.SUPPRESS)
    parser.add_argument("--times", type=int, default=1, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.part:
        repeat(options.part, options.times)
        return
    folder = options.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    plugin = folder / "count.so"
    subprocess.run(["gcc", "-shared", "-fPIC", "-O2", "-o", plugin, PLUGIN], check=True)
    print(f"{'millions of instructions':<52}" + "".join(f"{one.debian:>10}" for one in PROCESSORS))
    for processor in PROCESSORS:
        unpacked(processor, folder)
        sources_for(processor, folder)
    for part in PARTS:
        counted = partial(count, folder=folder, plugin=plugin, part=part)
        found = [(counted(one, times=REPETITIONS) - counted(one, times=0)) / REPETITIONS for one in PROCESSORS]
        print(f"{part:<52}" + "".join(f"{one / 1e6:>10.1f}" for one in found), flush=True)


if __name__ == "__main__":
    main()
