"""The next step of an error on a page: each action has words, and its button or link leads somewhere."""

import pytest

from rig.core.next_steps import Do, in_words
from rig.web.pages import JOB_OF_STEP, PAGE_OF_STEP, PAGES, page_actions
from rig.web.work import JOBS


def test_each_action_is_worded_for_a_page_and_for_a_terminal():
    actions = page_actions()
    assert actions.keys() == {str(action) for action in Do}
    for action in Do:
        shown = actions[str(action)]
        assert shown["words"]
        assert "rig " not in shown["words"]
        assert in_words(action()).endswith(".")
        assert (shown["job"] is None) or (shown["page"] is None)


@pytest.mark.parametrize("action", JOB_OF_STEP)
def test_each_button_is_a_job_that_takes_the_parameters_of_its_step(action):
    parameters = {Do.SET_REVOLUTIONS: {"revolutions": -1}, Do.EMPTY_TABLE: {"anyway": True}}.get(action, {})
    if action in (Do.ACKNOWLEDGE, Do.ACKNOWLEDGE_IN_PROGRAM):
        parameters = {"reboot": True}
    request = {**page_actions()[str(action)]["job"], **action(**parameters).parameters}
    assert type(JOB_OF_STEP[action]).model_validate(request)
    assert type(JOB_OF_STEP[action]) in JOBS


def test_each_link_leads_to_a_page():
    assert {page.removeprefix("/") for page in PAGE_OF_STEP.values()} <= PAGES.keys()
