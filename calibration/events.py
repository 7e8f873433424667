"""What a calibration tells while it measures, beside the events of the plans."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a measurement is: ``share`` of it, 0 to 1, and in ``words`` what was done last."""

    share: float
    words: str


@dataclass(frozen=True, slots=True)
class Ask:
    """Something that a person must do before the procedure goes on; it goes on when the next event is asked for.

    ``picture`` shows it on a terminal.
    """

    words: str
    picture: str = ""
