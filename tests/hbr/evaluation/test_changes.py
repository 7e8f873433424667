"""The shares of searches after a change of the bench."""

from dataclasses import replace

import numpy as np
import pytest

import hbr
from hbr.evaluation.changes import MAX_VIEWS, SearchResult, intervals, is_enrolled, summary
from hbr.evaluation.experiment import Experiment
from hbr.evaluation.protocol import Protocol
from rig.config import load_config


def result(leader: str, outcome: hbr.Outcome, views: int = 1, left_out: hbr.Outcome | None = None) -> SearchResult:
    return SearchResult((leader,) * 4, outcome, leader, views, left_out=left_out)


def test_shares_of_enrolled_objects_and_of_others_are_counted() -> None:
    known = {
        "a": [
            result("a", hbr.Outcome.FOUND, 1, hbr.Outcome.UNKNOWN),
            result("b", hbr.Outcome.FOUND, 3, hbr.Outcome.FOUND),
        ],
        "b": [
            result("b", hbr.Outcome.UNKNOWN, 4, hbr.Outcome.AMBIGUOUS),
            result("b", hbr.Outcome.AMBIGUOUS, 4, hbr.Outcome.AMBIGUOUS),
        ],
    }
    unknown = {"c": [result("a", hbr.Outcome.FOUND, 2), result("a", hbr.Outcome.UNKNOWN, 4)]}
    found = summary(known, unknown)
    assert (found["searches"], found["unknown_searches"], found["left_out_searches"]) == (4, 2, 4)
    assert (found["hit_rate_1"], found["hit_rate_4"]) == (0.75, 0.75)
    assert (found["decided_right"], found["decided_wrong"], found["called_unknown"]) == (0.25, 0.25, 0.25)
    assert found["ambiguous"] == 0.25
    assert (found["mean_views"], found["unknown_accepted"], found["left_out_accepted"]) == (2.0, 0.5, 0.25)


def test_stated_probabilities_are_compared_with_the_shares_of_right_answers() -> None:
    right, wrong = result("a", hbr.Outcome.FOUND), result("b", hbr.Outcome.FOUND)
    known = {
        "a": [
            replace(right, probability=0.99, not_enrolled=0.01),
            replace(wrong, probability=0.95, not_enrolled=0.03),
            replace(result("a", hbr.Outcome.UNKNOWN), probability=0.1, not_enrolled=0.9),
        ]
    }
    with_left_out = [
        replace(one, left_out=outcome, left_out_probability=0.97, left_out_not_enrolled=not_enrolled)
        for one, outcome, not_enrolled in zip(
            known["a"], (hbr.Outcome.FOUND, hbr.Outcome.UNKNOWN, hbr.Outcome.AMBIGUOUS), (0.03, 0.9, 0.6), strict=True
        )
    ]
    found = summary({"a": with_left_out}, {})
    assert (found["accepted_searches"], found["accepted_right"]) == (3, pytest.approx(1 / 3))
    assert found["accepted_stated"] == pytest.approx(0.97)
    assert found["enrolled_not_enrolled"] == pytest.approx(0.94 / 3)
    assert found["left_out_not_enrolled"] == pytest.approx(0.51)
    nothing = summary(known | {"a": known["a"][2:]}, {})
    assert (nothing["accepted_stated"], nothing["left_out_not_enrolled"]) == (None, None)


def test_a_search_takes_as_many_views_as_on_the_bench() -> None:
    assert load_config(None).identify.max_views == MAX_VIEWS


def test_every_ninth_object_is_never_enrolled() -> None:
    changed = Experiment("changed", protocol=Protocol(enrolled=18), change="mild", picture=False)
    assert [place for place in range(20) if not is_enrolled(place, changed)] == [8, 17]
    assert all(is_enrolled(place, replace(changed, change="none")) for place in range(20))


def test_intervals_resample_objects_and_not_searches() -> None:
    known = {"a": [result("a", hbr.Outcome.FOUND)] * 50, "b": [result("a", hbr.Outcome.FOUND)] * 50}
    found = intervals(known, np.random.default_rng(0))
    assert (found["decided_right_low"], found["decided_right_high"]) == (0, 1)  # both objects drawn, or only one
    assert (found["called_unknown_low"], found["called_unknown_high"]) == (0, 0)
