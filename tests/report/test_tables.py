import numpy as np

from smartview_jax.evaluation import Deviations, HeldOut, Rejection, Row
from smartview_jax.report import COMPARED, compared, remarks

FITTED = Deviations(np.array([[3.0, 4.0], [0.0, np.inf]]), np.full((2, 2), 1e-3))
UNSEEN = HeldOut(
    Deviations(np.array([[6.0, np.nan], [8.0, np.inf]]), np.full((2, 2), 2e-3)),
    ((0,), (1,)),
    ((1, "no pose"),),
    ((0, "ran out of steps"),),
)


def test_a_row_of_the_comparison_holds_the_figures():
    rejected = (Rejection("1", 5, "far"), Rejection("1", 6, "far"), Rejection("2", None, "empty"))
    row = compared(Row("joint", FITTED, UNSEEN, rejected))
    assert len(row) == len(COMPARED)
    # Mean and spread of 3, 4, 0; root mean square of the same, and of 6 and 8; mm at the target.
    assert row == ["joint", "2.33 +- 1.7", "2.89", "7.07", "2", "2, 1"]


def test_a_method_that_failed_shows_no_figures():
    assert compared(Row("joint", None, None, failure="no"))[1:] == ["failed", *"----"]


def test_remarks_say_what_the_figures_leave_out():
    assert remarks("joint", FITTED, UNSEEN) == [
        "joint: 1 points seen cannot be predicted at all",
        "joint: 1 held-out points seen cannot be predicted at all",
        "joint: fold 2 failed: no pose",
        "joint: fold 1 did not converge: ran out of steps",
    ]
    assert remarks("joint", None, None, "no pose at all") == ["joint: no pose at all"]
    whole = Deviations(np.ones((1, 2)), np.ones((1, 2)))
    assert remarks("joint", whole, HeldOut(whole, ((0,),), ())) == []
