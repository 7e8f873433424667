"""Write `docs/reference/faults.md` from measurements; a test compares the page with new measurements.

    python tests/faults/document.py [FAULT ...]

Without names the program measures all rows, which takes half a minute.
"""

import re
import sys
from math import ceil
from pathlib import Path
from tempfile import TemporaryDirectory

from sim.faults import fault_kinds
from tests.faults.fault_runs import LATE, SHORT, VIEWS, Outcome, answer, enrollment, identification, new_rig
from tests.faults.scenarios import SCENARIOS, Scenario

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "faults.md"
SLACK_S = 0.1
"""Measured times are rounded up to a multiple of this; the test allows once more of it."""
COLUMNS = (
    "fault",
    "what happens",
    "how it is detected",
    "within",
    "message",
    "recovery",
    "identification",
    "test",
)

HEAD = f"""# Faults

This page lists the faults that the simulator can produce. For each fault it shows how the rig detects it, the message,
and how to recover.

Each row is a test (`pytest tests/faults/test_every_fault.py -k jam`). With the real drivers on the simulated bench, the
test runs an enrollment of {VIEWS} views ({SHORT} if the fault does not stop it, {LATE} if the last view or
only a large move shows it) and an identification. Both complete or stop with the error code in the row. Afterwards:

- The table stands still and the servo's torque is off. Only a servo that cannot be reached holds the table.
- No view that was reported as stored is lost or damaged.
- Each stored view shows the object at its stored angle. The test images contain the true angle.
- When the cause is removed, the enrollment continues as the row says.

*Within* is the time from the beginning of the fault until the torque is off, on the bench's clock, for a fault that
begins during move 3. A dash means that the enrollment continues and the operator does nothing.

You can produce the faults on any simulated bench: `rig demo --fault jam@move3+2s`, or
`faults = ["jam@move3+2s"]` under `[bench.sim]` in `rig.toml`. `rig faults` lists the parameters. The notation is
`NAME:PARAMETER=VALUE@TIME`. The time is `12s`, `move3` or `view10`, optionally with a duration: `12s+2s`. Moves and
views are counted from 0.

The messages are those of a bench that stores its state. The simulated bench stores it only in `state_dir`.

`python tests/faults/document.py` writes this page. A test compares it with measurements.

"""


def row(scenario: Scenario, outcome: Outcome, identified: Outcome) -> tuple[str, ...]:
    """Return the cells of a fault."""
    return (
        f"`{scenario.name}`",
        fault_kinds()[scenario.name].what,
        sentence(scenario.found),
        "–" if outcome.error is None else f"{ceil(outcome.found_s / SLACK_S) * SLACK_S:.1f} s",
        message(outcome),
        recovery(scenario),
        identification_cell(identified),
        f"`test_every_fault.py[{scenario.name}]`",
    )


def message(outcome: Outcome) -> str:
    """Return the error message without the paths of this computer."""
    if outcome.error is None:
        return "None: all views are stored."
    error = outcome.error
    words = re.sub(r"/dev/fd/\d+", "/dev/i2c-1", error.what)
    words = re.sub(r"catalog /\S+?(?=[ ,;]|$)", "catalog", words)
    return f"{error.code} {error.title}: {words}{'' if words.endswith(('.', '?')) else '.'} *{error.next_step}*"


def masked(words: str) -> str:
    """Return ``words`` with each number replaced: it may change a little from version to version."""
    return re.sub(r"[+−-]?\d+(\.\d+)?", "#", words)


def recovery(scenario: Scenario) -> str:
    if scenario.code is None:
        return "Automatic."
    actions = [scenario.then, *([scenario.step.value] if scenario.step else []), scenario.after.value]
    return sentence(", ".join(action for action in actions if action))


def identification_cell(outcome: Outcome) -> str:
    if outcome.error is not None:
        return f"{outcome.error.code}"
    identified = answer(outcome)
    return "found" if identified and identified.name else "unknown"


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
    """Return how many views the enrollment plans: in small moves, or few if nothing stops it there."""
    return SHORT if scenario.code is None else LATE if scenario.late else VIEWS


def measure(name: str) -> tuple[str, ...]:
    scenario = SCENARIOS[name]
    with TemporaryDirectory() as folder:
        with new_rig(Path(folder) / "enrolled") as rig:
            outcome = enrollment(rig, scenario.fault, views=planned_views(scenario))
        with new_rig(Path(folder) / "identified") as rig:
            identified = identification(rig, scenario.of_identification)
    return row(scenario, outcome, identified)


def main() -> None:
    rows_before = documented() if sys.argv[1:] else {}
    rows = [
        measure(name) if name in sys.argv[1:] or name not in rows_before else rows_before[name]
        for name in fault_kinds()
    ]
    lines = [" | ".join(("", *COLUMNS, "")).strip(), "|" + "---|" * len(COLUMNS)]
    lines += [f"| {' | '.join(cells)} |" for cells in rows]
    PAGE.write_text(HEAD + "\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
