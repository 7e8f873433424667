"""`docs/faults.md`: written by this program, and held against what the tests measure.

    python tests/faults/document.py [FAULT ...]

Without names every row is measured anew, which takes a minute.
"""

import re
import sys
from math import ceil
from pathlib import Path
from tempfile import TemporaryDirectory

from sim.faults import kinds
from tests.faults.fault_runs import SHORT, VIEWS, Outcome, answer, enrollment, identification, new_rig
from tests.faults.scenarios import SCENARIOS, Scenario

PAGE = Path(__file__).parents[2] / "docs" / "faults.md"
SLACK_S = 0.1
"""A measured time is rounded up by as much; a test takes it for too long beyond twice that."""
COLUMNS = (
    "fault",
    "what happens",
    "how it is found",
    "within",
    "what the operator reads",
    "how it goes on",
    "an identification",
    "test",
)

HEAD = f"""# Faults

What can go wrong on a bench, how the rig finds it, and what the person beside it reads.

Every row is a test (`pytest tests/faults/test_every_fault.py -k jam`): an enrollment of {VIEWS} views, and an
identification, under the fault, with the real drivers on the simulated bench. Each is completed, or stopped with the
code that is given here. The table stands then, its torque off; only a servo that cannot be told any more holds it. No
view that was reported as stored is lost or damaged, and each shows the object at the angle that is stored with it: the
pictures carry their true angle. Afterwards the cause is taken away, and the enrollment goes on as the row says.

*Within* is the time from the beginning of the fault until the table is without torque, on the bench's own clock, for a
fault that begins during move 3. A dash: the work goes on, and nobody needs to do anything.

Faults happen on any simulated bench: `rig demo --fault jam@move3+2s`, `rig demo --faults FILE`, or
`faults = ["jam@move3+2s"]` under `[bench.sim]` in `rig.toml`. `rig faults` lists their parameters. Such a fault is
written `NAME:PARAMETER=VALUE@TIME`, where the time is `12s`, `move3` or `view10`, and `+2s` behind it is how long;
moves and views count from 0.

This page is written by `python tests/faults/document.py`; a test holds it against what is measured.

"""


def row(scenario: Scenario, outcome: Outcome, identified: Outcome) -> tuple[str, ...]:
    """Return the cells of a fault."""
    return (
        f"`{scenario.name}`",
        kinds()[scenario.name].what,
        sentence(scenario.found),
        "–" if outcome.error is None else f"{ceil(outcome.found_s / SLACK_S) * SLACK_S:.1f} s",
        message(outcome),
        goes_on(scenario),
        identification_cell(identified),
        f"`test_every_fault.py[{scenario.name}]`",
    )


def message(outcome: Outcome) -> str:
    """Return what the operator reads, without the paths of this computer."""
    if outcome.error is None:
        return "Nothing: all views are taken."
    error = outcome.error
    words = re.sub(r"/\S*sim-i2c-\w+", "/dev/i2c-1", error.what)
    words = re.sub(r"catalog /\S+?(?=[ ,;]|$)", "catalog", words)
    return f"{error.code} {error.title}: {words}{'' if words.endswith(('.', '?')) else '.'} *{error.next_step}*"


def masked(words: str) -> str:
    """Return ``words`` with all numbers alike: they may differ by a count from one version to the next."""
    return re.sub(r"[+−-]?\d+(\.\d+)?", "#", words)


def goes_on(scenario: Scenario) -> str:
    if scenario.code is None:
        return "By itself."
    deeds = [scenario.then, *([scenario.step.value] if scenario.step else []), scenario.after.value]
    return sentence(", ".join(deed for deed in deeds if deed))


def identification_cell(outcome: Outcome) -> str:
    if outcome.error is not None:
        return f"{outcome.error.code}"
    identified = answer(outcome)
    return "finds it" if identified and identified.name else "unknown"


def sentence(words: str) -> str:
    return f"{words[:1].upper()}{words[1:]}."


def documented() -> dict[str, tuple[str, ...]]:
    """Return the page's rows by the name of their fault."""
    rows = {}
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        cells = tuple(cell.strip() for cell in line.strip("|").split("|"))
        if line.startswith("| `") and len(cells) == len(COLUMNS):
            rows[cells[0].strip("`")] = cells
    return rows


def planned_views(scenario: Scenario) -> int:
    """Return how many views the enrollment plans: a full revolution in small moves, or few if nothing stops it."""
    return SHORT if scenario.code is None else VIEWS


def measure(name: str) -> tuple[str, ...]:
    scenario = SCENARIOS[name]
    with TemporaryDirectory() as folder:
        with new_rig(Path(folder) / "enrolled") as rig:
            outcome = enrollment(rig, scenario.fault, views=planned_views(scenario))
        with new_rig(Path(folder) / "identified") as rig:
            identified = identification(rig, scenario.of_identification)
    return row(scenario, outcome, identified)


def main() -> None:
    kept = documented() if sys.argv[1:] else {}
    rows = [measure(name) if name in sys.argv[1:] or name not in kept else kept[name] for name in kinds()]
    lines = [" | ".join(("", *COLUMNS, "")).strip(), "|" + "---|" * len(COLUMNS)]
    lines += [f"| {' | '.join(cells)} |" for cells in rows]
    PAGE.write_text(HEAD + "\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
