"""Names of version 0.1 work for one version, with a warning."""

import numpy as np
import pytest

import hbr


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("Look", "NextBestView"),
        ("Rules", "StoppingRule"),
        ("Sighting", "Segmentation"),
        ("Verdict", "StopDecision"),
        ("believe", "update_belief"),
        ("familiar_score", "open_set_threshold"),
        ("lead", "score_margin"),
        ("next_look", "next_best_view"),
        ("rehearse", "leave_one_out"),
        ("rules", "fit_stopping_rule"),
        ("sight", "segment"),
    ],
)
def test_old_names_give_the_new_objects(old: str, new: str) -> None:
    with pytest.warns(DeprecationWarning, match=f"hbr.{old} is now hbr.{new}"):
        assert getattr(hbr, old) is getattr(hbr, new)


def test_judge_decides_by_the_rule() -> None:
    views = hbr.Views.of_object("a", np.eye(4, 144, dtype=np.uint8) * 7, np.arange(4) * 90.0)
    index = hbr.DenseIndex(views)
    rule = hbr.calibrate_stopping_rule(index).rule
    belief = hbr.update_belief(views.descriptors[0], 0.0, index)
    with pytest.warns(DeprecationWarning, match="StoppingRule.decide"):
        judge = hbr.judge
    assert judge(belief, rule, max_views=3) == rule.decide(belief, max_views=3)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        hbr.nothing  # noqa: B018
