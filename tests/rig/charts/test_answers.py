"""The charts of recorded answers count days of the viewer's time, and show where the empty-table image was taken."""

from datetime import date, timedelta

from rig.charts.answers import DAYS, answers_a_day, drift_of_scores

TODAY = date(2026, 3, 2)


def test_answers_are_counted_by_day_for_two_weeks() -> None:
    answers = [(TODAY, True), (TODAY, False), (TODAY - timedelta(1), True), (TODAY - timedelta(DAYS), True)]
    every, others = answers_a_day(answers, TODAY).series
    assert list(every.y) == [0] * (DAYS - 2) + [1, 2]
    assert list(others.y) == [0] * (DAYS - 1) + [1]
    assert answers_a_day(answers, TODAY).x.names[-2:] == ("1.3.", "2.3.")


def test_line_stands_where_the_empty_table_was_photographed() -> None:
    scores, line = drift_of_scores([0.9, 0.8, None, 0.6], 2).series
    assert list(scores.x) == [1, 2, 3, 4]
    assert (list(line.x), list(line.y)) == ([2.5, 2.5], [0.6, 0.9])
    for before in (0, 4):  # before all of them, or after
        assert len(drift_of_scores([0.9, 0.8, None, 0.6], before).series) == 1
    assert "<svg" in drift_of_scores([], 0).svg()
