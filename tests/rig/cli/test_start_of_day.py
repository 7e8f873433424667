"""`rig empty-table`, and the question for it at the start of a day."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rig.bench import open_bench
from rig.catalog import Catalog
from rig.cli.ui.desk import CommandDesk
from rig.cli.ui.settings import Settings
from rig.config import load_config
from rig.events.events import Accepted
from rig.jobs.table_image import refresh_table_image
from rig.plans.enroll import enroll
from rig.views.empty_table import empty_table_status
from tests.small import SMALL, SMALL_WORDS


def test_name_is_checked_before_the_table_is_cleared(rig: Callable[..., Any]) -> None:
    """``dice`` is enrolled, the enrollment of ``toy-car`` is unfinished, and ``lamp`` is unknown."""
    bench = open_bench("sim", load_config(Path("rig.toml"), SMALL))
    with bench, Catalog.open("catalog", clock=bench.clock) as catalog:
        for _ in enroll(bench, catalog, "dice", views=4):
            pass
        unfinished = enroll(bench, catalog, "toy-car", views=4)
        next(event for event in unfinished if isinstance(event, Accepted))
        unfinished.close()
    Path("tray.csv").write_text("name\ndice\n")
    before = Path("state/sim/state.json").read_bytes()
    for arguments, code in (
        (("dice",), 7),
        (("toy-car",), 7),
        (("lamp", "--resume"), 7),
        (("dice", "--resume"), 7),
        (("a\nb",), 2),
        (("--list", "tray.csv"), 0),
    ):
        done = rig("enroll", *arguments, *SMALL_WORDS)
        assert done.exit_code == code, arguments
        assert "Empty-table image" not in done.stderr
    assert Path("state/sim/state.json").read_bytes() == before


def test_rejected_enrollment_leaves_no_object(rig: Callable[..., Any]) -> None:
    assert rig("enroll", "unicorn", "--views", "4").exit_code == 7
    assert rig("enroll", "dice", "--views", "4", "--set", "table.zero_deg=90").exit_code == 5  # it does not start
    assert len(list(Path("catalog").rglob("*.png"))) == 1  # the empty-table image, which the next enrollment uses
    assert "No objects yet" in rig("catalog", "list").stdout


class Answers(io.StringIO):
    """An operator who types these lines at a terminal, and takes the object off and puts it on as asked."""

    def __init__(self, text: str, asked: Callable[[], None] = lambda: None) -> None:
        super().__init__(text)
        self._asked = asked

    def isatty(self) -> bool:
        return True

    def readline(self, size: int | None = -1) -> str:
        self._asked()
        return super().readline(-1 if size is None else size)


@pytest.fixture
def asked(
    simulated: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[Any, str]]:
    """Return a function that asks an operator with an object on the table; the answers are lines of text."""

    def run(
        answers: Answers | io.StringIO, *, ask: bool = True, as_json: bool = False, stays: bool = False
    ) -> tuple[Any, str]:
        s = simulated()
        s.operator.place("toy-car")
        s.bench.placer = None
        if isinstance(answers, Answers) and not stays:
            times = iter(range(99))
            answers._asked = lambda: s.world.put(None) if next(times) == 1 else None  # forgotten the first time
        monkeypatch.setattr("sys.stdin", answers)
        desk = CommandDesk(Settings(json=as_json))
        desk.run("enroll", refresh_table_image(desk, s.bench, s.bench.placer, ask=ask, then="toy-car"))
        return empty_table_status(s.bench).table, capsys.readouterr().err

    return run


def test_operator_is_asked_again_if_an_object_is_on_the_table(asked: Callable[..., tuple[Any, str]]) -> None:
    table, said = asked(Answers("\n\n\n"))
    assert table is not None
    assert "There is no empty-table image yet. Take everything off the table." in said
    assert "Something is on the table" in said
    assert said.count("Enter: take the image") == 2
    assert "Put toy-car on the table" in said


def test_fixed_parts_on_the_table_are_accepted_on_request(asked: Callable[..., tuple[Any, str]]) -> None:
    table, said = asked(Answers("k\n\nk\n\n"), stays=True)
    assert table is not None
    assert table.evidence["turning_share"] > 0.004
    assert said.count("Enter: take the image, s: continue") == 2  # k counts only after the check has failed
    assert said.count("k: keep what is there") == 1


@pytest.mark.parametrize("answer", ["s\n", "what?\ns\n", ""])
def test_operator_can_continue_without_the_image(asked: Callable[..., tuple[Any, str]], answer: str) -> None:
    table, said = asked(Answers(answer))
    assert table is None
    assert "s: continue without\n  (without it, objects are found only before a plain background" in said
    assert "Put toy-car" not in said


@pytest.mark.parametrize(
    ("terminal", "options"), [(Answers, {"ask": False}), (Answers, {"as_json": True}), (io.StringIO, {})]
)
def test_automation_is_never_asked(
    asked: Callable[..., tuple[Any, str]], terminal: type[io.StringIO], options: dict[str, bool]
) -> None:
    table, said = asked(terminal("\n\n\n"), **options)
    assert table is None
    assert said.startswith("Note: there is no empty-table image yet;")
    assert "Take a new empty-table image: `rig empty-table`" in said
