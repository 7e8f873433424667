"""Write the printed parts as STL and STEP: `make hardware`."""

import sys
from pathlib import Path

from build123d import Compound, export_step, export_stl

from docs.hardware.assembly import frame, table
from docs.hardware.parts import every_part


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    made = every_part()
    for name, part in made.items():
        export_stl(part, str(folder / f"{name}.stl"), tolerance=0.02, angular_tolerance=0.1)
        export_step(part, str(folder / f"{name}.step"))
    export_step(Compound([item.solid for item in (*table(), *frame())]), str(folder / "bench.step"))
    print(f"{len(made)} parts as STL and STEP, and the bench as STEP, in {folder}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
