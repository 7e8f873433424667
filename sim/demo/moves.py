"""The first search of the demo as a growing table: a line for each view, with measurements, candidates and decision."""

from typing import ClassVar

from rig.core.phrases import azimuth_words, distinct, percent_words, signed
from rig.events.events import Accepted, Decided, Event, Identified, Moved, Ranked
from rig.events.lines import line
from rig.events.wording import NOT_ENROLLED, share_words


def _row(view: object, azimuth: str, rotation: tuple[str, str, str], similarity: tuple[str, str], rest: str) -> str:
    asked, encoder, imu = rotation
    first, second = similarity
    return f"{view:>4}{azimuth:>9}{asked:>8}{encoder:>11}{imu:>18}{first:>12}{second:>11}  {rest}"


def _heading(first: str, second: str, candidates: str) -> str:
    groups = f"{'camera':>13}   {'rotation of the table'}{'similarity of candidates':>36}"
    names = _row("view", "azimuth", ("asked", "encoder", "IMU"), (first, second), f"{'next view':<12}{candidates}")
    return f"{groups}\n{names}"


class MoveLines:
    """Converts the events of `rig.plans.identify` to lines; a line is complete when the next view is decided."""

    HEADING: ClassVar = _heading("left", "right", "candidates, score")
    DENSE_HEADING: ClassVar = _heading("at next", "overall", "candidates, probability")

    def __init__(self) -> None:
        self._asked_deg: float | None = None
        self._rest_deg = 0.0
        self._move: Moved | None = None
        self._azimuth_deg = 0.0
        self._ranked: Ranked | None = None

    def add(self, event: Event) -> str:
        """Take the next event; return the line that it completes, or an empty string."""
        match event:
            case Moved():
                self._move = event
                self._rest_deg = event.encoder_deg
            case Accepted():
                self._azimuth_deg = event.azimuth_deg
            case Ranked():
                self._ranked = event
            case Decided():
                text = self._line(event)
                self._asked_deg = event.target_deg - self._rest_deg
                return text
            case Identified():
                return f"{self._line(None)}\n{line(event)}"
            case _:
                return line(event)
        return ""

    def _line(self, decided: Decided | None) -> str:
        assert self._move is not None  # every view follows a Moved event
        move = self._move
        rotation = "–", "–", "–"
        if self._asked_deg is not None:
            imu = "no value"
            if move.rotation_imu_deg is not None and move.imu_sigma_deg is not None:
                imu = f"{signed(move.rotation_imu_deg, 2)} ± {move.imu_sigma_deg:.2f}°"
            rotation = f"{signed(self._asked_deg, 1)}°", f"{signed(move.rotation_encoder_deg, 2)}°", imu
        similarity = "–", "–"
        if decided and decided.s_left is not None and decided.s_right is not None:
            left, right = distinct(decided.s_left, decided.s_right, decimals=3)
            similarity = left, right
        if decided and decided.weighed is not None and decided.weighed.similarity is not None:
            weighed = decided.weighed.similarity
            there = weighed[decided.weighed.rotations_deg.index(decided.rotation_deg)]
            similarity = f"{there:.2f}", f"{min(weighed):.2f}–{max(weighed):.2f}"
        goes = f"{decided.side:<5} {abs(decided.rotation_deg):3.0f}°" if decided else "–"
        assert self._ranked is not None
        leading = ", ".join(f"{c.name} {share_words(c) or f'{c.score:.3f}'}" for c in self._ranked.candidates[:3])
        if self._ranked.decision is not None:
            leading += f", {NOT_ENROLLED} {percent_words(self._ranked.decision.not_enrolled)}"
        note = "" if move.agrees else "  encoder and IMU differ"
        azimuth = f"{azimuth_words(self._azimuth_deg)}°"
        return _row(move.index + 1, azimuth, rotation, similarity, f"{goes:<12}{leading}{note}")
