"""What a calibration tells while it measures, beside the events of the plans."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a measurement is: ``share`` of it, 0 to 1, and in ``words`` what was done last."""

    share: float
    words: str
