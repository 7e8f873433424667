"""What happened, in words: the same on the terminal and in the report."""

from collections.abc import Iterable, Sequence
from math import isfinite

from hbr import Verdict
from rig.events.events import Decided, Identified, Moved, SimilarObject, SimilarObjects, Unwinding


def decision_words(decided: Decided) -> str:
    """Return why the camera goes to a side, and how far: "left: the rivals look less alike there …; turning 47.3°."."""
    turning = f"turning {abs(decided.rotation_deg):.1f}°"
    # A step of AHBR is at most 90°; what exceeds it leads past views that were taken before (`hbr.next_view`).
    compared = decided.s_left is not None
    past = " past what was seen already" if compared and round(abs(decided.rotation_deg), 1) > 90 else ""
    return f"{decided.side}: {decided.why}; {turning}{past}."


def side_words(side: str, s_left: float, s_right: float, rivals: Sequence[str]) -> str:
    """Return why a side was chosen: how alike the rivals look from the left and from the right (Eq. 6)."""
    if len(rivals) < 2:
        return "no second candidate is in sight to be told apart"
    left, right = distinct(s_left, s_right)
    leading = "the two leading candidates" if len(rivals) == 2 else "the leading candidates"
    if s_left == s_right:
        return f"{leading} look as much alike on both sides: S_left {left} = S_right {right}"
    if side == "left":
        return f"{leading} look less alike there: S_left {left} < S_right {right}"
    return f"{leading} look less alike there: S_right {right} < S_left {left}"


def separation_words(rivals: Sequence[str], alike: Sequence[float] | None, chosen: int) -> str:
    """Return what a turn of the dense search is to show: which two objects it separates, and how well."""
    if len(rivals) < 2 or alike is None:
        return "no second object is likely, and that side is new"
    here = alike[chosen]
    least, most = min(alike), max(alike)
    return f"to tell {rivals[0]} from {rivals[1]}, {here:.2f} alike there ({least:.2f} to {most:.2f} all around)"


def verdict_words(verdict: Verdict, *, certainty: float, least: float, views: int) -> str:
    """Return what the rules of the dense search say after ``views`` views, and why.

    Parameters
    ----------
    verdict
        Theirs.
    certainty
        Probability that ends a search.
    least
        Familiarity that enrolled objects reach; not finite where nothing may be called unknown.
    views
        That were taken.
    """
    probability, familiarity = percent_words(verdict.probability), f"{verdict.familiarity:.3f}"
    familiar = not isfinite(least) or verdict.familiarity >= least
    known = f" and a familiarity of {familiarity} the {least:.3f} of enrolled objects" if isfinite(least) else ""
    if verdict.kind == "unknown":
        return f"a familiarity of {familiarity} stays below the {least:.3f} that enrolled objects reach"
    if verdict.kind == "look" and not familiar:
        return f"not familiar yet: {familiarity}, and enrolled objects reach {least:.3f}"
    if verdict.kind == "look":
        return f"not sure yet: a probability of {probability}, and {percent_words(certainty)} ends the search"
    if verdict.probability >= certainty:
        return f"a probability of {probability} reaches {percent_words(certainty)}{known}"
    views_words = counted(views, "view")
    return f"the best after {views_words}, with a probability of {probability}; {percent_words(certainty)} is sure"


def percent_words(probability: float) -> str:
    """Return a probability in percent; what is nearly none or nearly all as such."""
    if probability > 0.999:
        return ">99.9%"
    return "<0.1%" if probability < 0.001 else f"{probability:.1%}"


def move_words(moved: Moved) -> str:
    """Return the table's rotation as encoder and gyro measured it, and whether they agree."""
    words = f"rotation {signed(moved.rotation_encoder_deg, 2)}° (encoder)"
    if moved.rotation_imu_deg is None:
        return f"{words}, no gyro value"
    sigma = "" if moved.imu_sigma_deg is None else f" ± {moved.imu_sigma_deg:.2f}"
    words += f", {signed(moved.rotation_imu_deg, 2)}{sigma}° (gyro)"
    if moved.agrees:
        return words
    bound = "" if moved.bound_deg is None else f" by more than {moved.bound_deg:.2f}°"
    return f"{words}; they differ{bound}, so the gyro value counts"


def unwinding_words(unwinding: Unwinding) -> str:
    """Return that the table frees its cable by a long rotation, and why."""
    low, high = (f"{angle:g}°".replace("-", "−") for angle in unwinding.limits_deg)
    back = counted(unwinding.turns, "revolution")
    return (
        f"Unwinding the cable: the table rotates from {angle_words(unwinding.from_deg)} to "
        f"{angle_words(unwinding.to_deg)} ({back} back; the cable allows {low} to {high})"
    )


def result_words(answer: Identified) -> str:
    """Return the result alone: "mug-white, rotated 70°, 99 % confident (2 views)".

    An unknown object is given with its three most similar enrolled objects.
    """
    if answer.name is None:
        similar = [f"{candidate.name} (score {candidate.score:.3f})" for candidate in answer.candidates[:3]]
        verb = "objects are" if len(similar) > 1 else "object is"
        return f"Unknown object. The most similar enrolled {verb} {joined(similar)}."
    words = f"{answer.name}, rotated {round(answer.yaw_deg) % 360}°"
    if answer.probability is not None:
        percent = ">99.9" if answer.probability > 0.999 else min(round(answer.probability * 100), 99)
        words += f", {percent} % confident"
    return f"{words} ({counted(answer.views, 'view')})"


def answer_lines(answer: Identified) -> list[str]:
    """Return the result, a doubt if there is one, and why the search ended."""
    lines = [result_words(answer)]
    if answer.name is not None and answer.margin <= 0 and len(answer.candidates) > 1:
        lines.append(f"Not certain: {answer.candidates[1].name} is similarly likely.")
    return [*lines, sentence(answer.reason)]


def answer_words(answer: Identified) -> str:
    """Return the answer in sentences: the result first, then why the search ended."""
    result, *rest = answer_lines(answer)
    return " ".join([f"{result.removesuffix('.')}.", *rest])


def symmetry_words(similar: SimilarObjects) -> str:
    """Return what an object's views say about its pose; nothing where they say nothing."""
    if similar.period_deg is None or similar.neighbours is None or similar.alike is None:
        return ""
    numbers = f"similarity {similar.alike:.3f}, of neighbouring views {similar.neighbours:.3f}"
    if similar.period_deg == 0:
        return f"looks alike from everywhere (least {numbers}): its pose will not be known"
    if similar.period_deg < 360:
        return f"looks the same every {similar.period_deg:g}° ({numbers}): its pose will be known up to that"
    return ""


def similar_object_words(one: SimilarObject) -> str:
    """Return from which sides an object looks like another one: "looks like mug-03 from 120–200°"."""
    if one.arcs_deg == ((0.0, 360.0),):
        return f"looks like {one.name} from all sides"
    arcs = [f"{a:.0f}°" if a == b else f"{a:.0f}–{b:.0f}°" for a, b in one.arcs_deg]
    several = f"{', '.join(arcs[:-1])} and {arcs[-1]}" if len(arcs) > 1 else arcs[0]
    return f"looks like {one.name} {'at' if all(a == b for a, b in one.arcs_deg) else 'from'} {several}"


def similar_objects_words(similar: SimilarObjects) -> list[str]:
    """Return what an object will be taken for, a line for each finding."""
    lines = [words] if (words := symmetry_words(similar)) else []
    lines += [f"{similar_object_words(one)} (similarity up to {one.similarity:.3f})" for one in similar.lookalikes]
    return lines if similar.lookalikes else [*lines, "looks like no other enrolled object"]


def duration_words(seconds: float) -> str:
    """Return a time as people read it: "43 s", "2 min 05 s", "1 h 20 min"."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def sentence(words: str) -> str:
    """Return ``words`` with a capital and a full stop."""
    return f"{words[:1].upper()}{words[1:]}."


def azimuth_words(azimuth_deg: float) -> str:
    """Return an azimuth to a tenth of a degree, from 0.0 to 359.9, without its sign for degrees."""
    return f"{round(azimuth_deg, 1) % 360:.1f}"


def counted(n: int, noun: str) -> str:
    """Return "1 view", "2 views"."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def angle_words(angle_deg: float, decimals: int = 1) -> str:
    """Return an angle of the table: "−12.5°"."""
    return f"{round(angle_deg, decimals) + 0.0:.{decimals}f}°".replace("-", "−")  # + 0.0 removes the sign of a zero


def joined(items: Sequence[str]) -> str:
    """Return items as an English list: "a, b and c"."""
    return f"{', '.join(items[:-1])} and {items[-1]}" if len(items) > 1 else "".join(items)


def short(words: str, letters: int) -> str:
    """Return words cut to so many letters, the last of them "…"."""
    return words if len(words) <= letters else f"{words[: letters - 1]}…"


def listed(items: Iterable[str]) -> str:
    """Return distinct items, in the order of their first appearance, separated by semicolons."""
    return "; ".join(dict.fromkeys(items))


def distinct(a: float, b: float, *, decimals: int = 2) -> tuple[str, str]:
    """Return two numbers with as many decimals as tell them apart: ``decimals`` at least, five at most."""
    enough = next((d for d in range(decimals, 5) if f"{a:.{d}f}" != f"{b:.{d}f}"), 5) if a != b else decimals
    return f"{a:.{enough}f}", f"{b:.{enough}f}"


def signed(value: float, decimals: int) -> str:
    """Return a number with its sign, a real minus."""
    return f"{value:+.{decimals}f}".replace("-", "−")
