"""The display of a running plan: a live table on a terminal, one line for each view in a pipe."""

from abc import abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Self

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from rig.cli.ui.keys import HINT, Pause
from rig.config import RigConfig
from rig.core.phrases import angle_words, azimuth_words, counted, duration_words, percent, percent_words, signed
from rig.events.events import (
    Accepted,
    Decided,
    Enrolled,
    Event,
    FrameUsed,
    Identified,
    Moved,
    Ranked,
    Rejected,
    SimilarObjects,
    Started,
    Waiting,
)
from rig.events.lines import line
from rig.events.wording import (
    NOT_ENROLLED,
    decision_words,
    move_words,
    ranking_words,
    share_words,
    similar_objects_words,
)
from rig.motion.move import MotionTimes
from rig.plans.estimate import TimeLeft
from rig.views.capture import ViewEvidence, rejection_text

ROWS: Final = 12
"""Largest number of rows in the live table."""


class LiveView(AbstractContextManager["LiveView"]):
    """Shows the events of a plan while it runs and lets the operator pause it; use it in a ``with`` block.

    A pipe gets plain lines. ``keys`` pause the plan, unless the operator types answers meanwhile.
    """

    def __init__(self, console: Console, *, keys: bool = True) -> None:
        self._console = console
        self._live: Live | None = None
        self._pause = Pause(keys=keys and console.is_terminal)
        self._paused = ""

    def __enter__(self) -> Self:
        self._pause.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()
        self._pause.__exit__(kind, error, trace)

    def add(self, event: Event) -> None:
        """Show the next event; if the operator pauses the plan here, return when the operator resumes it."""
        if self.show(event):
            self._pause.point(self._show_pause)

    @abstractmethod
    def show(self, event: Event) -> bool:
        """Show an event and return whether the plan can pause after it."""

    def note(self, text: str) -> None:
        """Print a line that stays on the screen, above the live table."""
        if text:
            self._console.print(text, markup=False, highlight=False, soft_wrap=not self._console.is_terminal)

    @abstractmethod
    def render(self) -> RenderableType:
        """Return the present content of the live table."""

    def _show_pause(self, words: str) -> None:
        """Show in the live table that the plan pauses and how to resume it; in a pipe print a line."""
        self._paused = words
        if self._live is not None:
            self._live.refresh()
        else:
            self.note(words or "Resumed.")

    def _start(self) -> None:
        if self._console.is_terminal and self._live is None:
            self._live = Live(
                console=self._console,
                get_renderable=self.render,
                refresh_per_second=8,
                redirect_stdout=False,  # Rich would interpret terminal escapes in what is printed meanwhile
                redirect_stderr=False,
            )
            self._live.start(refresh=True)  # a plan of a few fast views also shows the keys

    def _stop(self) -> None:
        """End the live table; it stays on the screen, and new lines appear below it."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    @property
    def _hint(self) -> Text:
        """Return what the operator can do now: how to resume a pause, or the keys."""
        if self._paused:
            return Text(self._paused, style="bold yellow")
        stop = "Ctrl+C: stop"
        return Text(f"{HINT}, {stop}" if self._pause.listens else stop, style="dim")


WIDE, NARROW = 88, 60
"""Width of a terminal, in characters, that fits all columns of a table, and most of them."""


@dataclass(frozen=True, slots=True)
class ShownView:
    """An image of an enrollment, accepted or rejected."""

    number: int
    move: Moved | None
    evidence: ViewEvidence
    result: str
    accepted: bool

    @property
    def imu(self) -> str:
        """The table angle by the gyro, with its uncertainty."""
        if self.move is None or self.move.rotation_imu_deg is None:
            return "–"
        angle_deg = self.move.encoder_deg - self.move.rotation_encoder_deg + self.move.rotation_imu_deg
        sigma = "" if self.move.imu_sigma_deg is None else f" ± {self.move.imu_sigma_deg:.2f}"
        return f"{angle_words(angle_deg, 2).removesuffix('°')}{sigma}°"

    @property
    def angle(self) -> str:
        """The table angle of a view in motion with its uncertainty, by encoder and gyro together."""
        if self.evidence.motion is None:
            return "–" if self.move is None else angle_words(self.move.encoder_deg, 2)
        motion = self.evidence.motion
        return f"{angle_words(motion.angle_deg, 2).removesuffix('°')} ± {motion.angle_sigma_deg:.2f}°"

    @property
    def motion(self) -> str:
        """The table's speed, and how far the edge of the region moved during the exposure."""
        motion = self.evidence.motion
        return "at rest" if motion is None else f"{motion.speed_dps:.0f} °/s, {motion.smear_px:.1f} px"


Columns = tuple[tuple[str, int, Callable[[ShownView], str]], ...]

COLUMNS: Final[Columns] = (
    ("view", 0, lambda row: str(row.number)),
    ("asked", NARROW, lambda row: "–" if row.move is None else angle_words(row.move.commanded_deg, 2)),
    ("encoder", 0, lambda row: "–" if row.move is None else angle_words(row.move.encoder_deg, 2)),
    ("IMU", NARROW, lambda row: row.imu),
    ("sharpness", NARROW, lambda row: f"{row.evidence.sharpness:.1f}"),
    ("brightness", WIDE, lambda row: f"{row.evidence.mean_level:.0f}"),
    ("saturated", WIDE, lambda row: percent(row.evidence.saturated_share, 0)),
)
"""Columns of an enrollment's table: heading, width that the terminal needs to show it, and cell."""

COLUMNS_IN_MOTION: Final[Columns] = (
    COLUMNS[0],
    ("table angle", 0, lambda row: row.angle),
    ("speed and smear", NARROW, lambda row: row.motion),
    *COLUMNS[4:],
)
"""The columns if views are taken in motion."""


class EnrollView(LiveView):
    """The table of an enrollment, with a row for each image.

    ``heading`` is the text before the object's name, such as "3 of 25".
    """

    def __init__(self, console: Console, config: RigConfig, heading: str = "") -> None:
        super().__init__(console)
        self._model = MotionTimes(config)
        self._heading = heading
        self._name = ""
        self._of = 0
        self._taken = 0
        self._rows: list[ShownView] = []
        self._move: Moved | None = None
        self._left: TimeLeft | None = None
        self._findings: list[str] = []
        self._ended = False

    def show(self, event: Event) -> bool:
        if self._left is not None:
            self._left.add(event)
        match event:
            case Started():
                self._name, self._of = event.name or "", event.views
                self._left = TimeLeft(self._model, event.angles_deg, in_motion=event.in_motion)
                self._start()
                if not self._console.is_terminal:
                    self.note(f"{self._title}: {counted(self._of, 'view')}, about {duration_words(self._left.seconds)}")
            case Moved():
                self._move = event
                if not event.agrees:
                    self.note(f"  {move_words(event)}")
            case Rejected():
                texts = "; ".join(rejection_text(reason, event.evidence) for reason in event.reasons)
                self._add(event.evidence, f"rejected: {texts}", accepted=False)
            case Accepted():
                self._taken += 1
                self._add(event.evidence, "accepted", accepted=True)
            case Enrolled():
                self._ended = True
                self._stop()
                self.note(line(event))
                for words in self._findings:
                    self.note(f"  {words}")
            case SimilarObjects():
                self._findings = similar_objects_words(event)
            case _:
                self.note(line(event))
        return isinstance(event, Accepted)

    @property
    def _title(self) -> str:
        return f"{self._heading} {self._name}".strip()

    @property
    def _columns(self) -> Columns:
        return COLUMNS_IN_MOTION if any(row.evidence.motion for row in self._rows) else COLUMNS

    def _add(self, evidence: ViewEvidence, result: str, *, accepted: bool) -> None:
        row = ShownView(self._taken if accepted else self._taken + 1, self._move, evidence, result, accepted)
        self._rows.append(row)
        del self._rows[:-ROWS]
        if not self._console.is_terminal:
            left = f"  {duration_words(self._left.seconds)} left" if self._left and accepted else ""
            cells = "  ".join(f"{heading} {cell(row)}" for heading, _, cell in self._columns[1:])
            self.note(f"view {row.number} of {self._of}  {cells}  {result}{left}")

    def render(self) -> RenderableType:
        width = self._console.width
        columns = [(heading, cell) for heading, needed, cell in self._columns if width >= needed]
        table = Table(box=None, pad_edge=False)
        for heading, _ in columns:
            table.add_column(heading, justify="right", no_wrap=True)
        table.add_column("", overflow="fold")
        for row in self._rows[-max(3, min(ROWS, self._console.height - 6)) :]:
            result = Text(f"{'✓' if row.accepted else '✗'} {row.result}", style="green" if row.accepted else "yellow")
            table.add_row(*(cell(row) for _, cell in columns), result)
        if self._ended:
            return table
        bar = Table.grid(padding=(0, 1))
        left = f"{duration_words(self._left.seconds)} left" if self._left and self._of else ""
        bar.add_row(
            Text(self._title, style="bold"),
            ProgressBar(
                total=max(1, self._of), completed=self._taken, width=max(8, min(40, width - 60)), complete_style="cyan"
            ),
            f"{self._taken}/{self._of}",
            left,
            self._hint if width >= WIDE and not self._paused else "",
        )
        state = [self._hint] if self._paused else []
        return Group(table, bar, *state) if self._rows else Group(bar, *state)


def _bar(share: float) -> ProgressBar:
    return ProgressBar(total=1.0, completed=max(0.0, min(1.0, share)), width=24, complete_style="cyan")


class IdentifyView(LiveView):
    """The candidates after each view, and the decisions."""

    def __init__(self, console: Console, *, keys: bool = True) -> None:
        super().__init__(console, keys=keys)
        self._begun: str | None = None
        self._ranked: Ranked | None = None
        self._used: FrameUsed | None = None
        self._taken = 0
        self._of = 0
        self._azimuth_deg = 0.0
        self._ended = False

    def show(self, event: Event) -> bool:
        match event:
            case Started():
                self._ranked, self._taken, self._of, self._ended = None, 0, event.views, False
                self._start()
            case Moved():
                self._used = None
            case Accepted():
                self._taken, self._azimuth_deg = event.index + 1, event.azimuth_deg
            case FrameUsed():
                self._used = event
            case Ranked():
                self._ranked = event
            case Identified():
                self._ended = True
                self._stop()
            case Waiting():
                self._stop()
        for text in self._lines(event):
            self.note(text)
        return isinstance(event, Decided)

    def _lines(self, event: Event) -> list[str]:
        """Return the lines about an event that stay on the screen."""
        plain = not self._console.is_terminal
        match event:
            case Started() if line(event) == self._begun:  # of one search after the other, once
                return []
            case Started():
                self._begun = line(event)
            case Accepted() if plain and event.evidence.motion is not None:  # a frame in motion has its own line
                return []
            case Decided() if plain:
                return [f"  {self._decision}" if self._decision else "", line(event)]
            case Decided():
                decision = f"{self._decision}; " if self._decision else ""
                return [f"view {self._taken}  {self._leading}  {decision}{decision_words(event)}"]
            case Moved() if not plain:
                return [] if event.agrees else [f"  {move_words(event)}"]
            case Accepted() | FrameUsed() | Ranked() if not plain:
                return []
        return [line(event)]

    @property
    def _leading(self) -> str:
        if self._ranked is None:
            return ""
        best = self._ranked.candidates[0]
        return f"{best.name} {share_words(best) or signed(self._ranked.margin, 3)}"

    @property
    def _decision(self) -> str:
        return ranking_words(self._ranked)

    def render(self) -> RenderableType:
        table = Table(box=None, pad_edge=False, expand=False)
        for heading in ("", "candidate"):
            table.add_column(heading)
        for heading in ("score", "behind", "pose"):
            table.add_column(heading, justify="right")
        candidates = self._ranked.candidates if self._ranked else ()
        # The paper's search has no probabilities, and a narrow terminal no room for bars.
        shares = [share_words(one) for one in candidates]
        likely = any(shares)
        if likely:
            table.add_column("probability", justify="right")
        wide = self._console.width >= NARROW
        if wide:
            table.add_column("")
        for place, (one, words) in enumerate(zip(candidates, shares, strict=True), 1):
            behind = "" if place == 1 else signed(one.score - candidates[0].score, 3)
            cells: list[RenderableType] = [
                str(place),
                Text(one.name, style="bold" if place == 1 else ""),
                f"{one.score:.3f}",
                behind,
                f"{azimuth_words(one.pose_deg)}°",
                *([words] if likely else []),
            ]
            if wide:
                share = one.score if not words or one.probability is None else one.probability
                cells.append(_bar(share))
            table.add_row(*cells)
        if self._ranked is not None and self._ranked.decision is not None:
            share = self._ranked.decision.not_enrolled
            table.add_row("", NOT_ENROLLED, "", "", "", percent_words(share), *([_bar(share)] if wide else []))
        if self._ended:
            return table if candidates else Group()
        # Below the table: where the search is, and its last decision.
        where = f", azimuth {azimuth_words(self._azimuth_deg)}°" if self._taken else ""
        lead = f", margin {signed(self._ranked.margin, 3)}" if self._ranked else ""
        taken = f"view {self._taken} of {self._of} at most{where}{lead}"
        status = Text(line(self._used).strip() if self._used else taken, style="bold")
        if not self._paused:
            status.append("   ").append_text(self._hint)
        lines = [Text(self._decision)] if self._decision else []
        lines += [status, self._hint] if self._paused else [status]
        return Group(table, *lines) if candidates else Group(*lines)
