"""Why a view was chosen is said in a clause that fits the verdict and the numbers of things."""

from types import SimpleNamespace

import numpy as np
import pytest

from smartview_jax.localization.next_views.view_gains import ViewGains

ERROR = "; the position error (std) goes from 2 to 1 mm; "
UNREACHED = "the view along the normal of the top surface is out of reach"


def reason(paper=None, gain=0.0, **given):
    """The reason of the second of three views."""
    numbers = {"rivals": 0, "count": 1, "is_open": False} | given
    gains = SimpleNamespace(
        discrimination=np.array([0.0, gain, 0.0]),
        total=np.array([1.0, 4.0, -np.inf]),
        std_before=2e-3,
        std_after=np.full(3, 1e-3),
        **numbers,
    )
    for name in ("_expected_gain", "_paper_clause"):
        setattr(gains, name, getattr(ViewGains, name).__get__(gains))
    return ViewGains.reason(gains, 1, paper)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (
            {"rivals": 1, "gain": 2.303},
            "it separates the object from 1 remaining rival (expected odds 10",
        ),
        (
            {"rivals": 2, "gain": 2.303},
            "it separates the object from 2 remaining rivals (expected odds",
        ),
        ({"is_open": True, "gain": 2.303}, "it decides whether the object is there (expected odds"),
        ({"count": 2, "gain": 2.303}, "it makes the objects more certain (expected odds"),
        ({"gain": 2.303}, "it makes the object more certain (expected odds"),
        ({"is_open": True}, "the object is still open, and the view shows it again;"),
        (
            {"is_open": True, "count": 2},
            "the objects are still open, and the view shows them again;",
        ),
        ({}, "the object is certain already;"),
        ({"count": 2}, "the objects are certain already;"),
    ],
)
def test_words_follow_the_verdict_and_the_numbers(given, told):
    text = reason(**given)
    assert text.startswith(told)
    assert text.endswith(ERROR + UNREACHED)


@pytest.mark.parametrize(
    ("paper", "said"),
    [
        (0, "the paper's view, along the normal of the top surface, would gain 25% as much"),
        (1, "it is the paper's view, along the normal of the top surface"),
        (2, "the paper's view, along the normal of the top surface, would gain 0% as much"),
    ],
)
def test_the_papers_view_is_compared_with_the_chosen_one(paper, said):
    assert reason(paper).endswith(ERROR + said)
