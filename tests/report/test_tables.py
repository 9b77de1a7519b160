import dataclasses

import jax.numpy as jnp
import numpy as np

from smartview_jax import Noise, fit_joint
from smartview_jax.evaluation import Deviations, Foretold, HeldOut, Rejection, Row, Unseen
from smartview_jax.joint import Alternative, NoiseEstimate
from smartview_jax.joint.doubt import Doubt
from smartview_jax.report import COMPARED, Summary, compared, remarks, table_rows
from smartview_jax.report.tables import errors_found
from smartview_jax.robots import LinearInPosition, RobotError
from smartview_jax.simulation import random_scene

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
    # Drawing two views anew gives the one, the other, or both.
    assert row == ["joint", "2.33 +- 1.7", "2.89", "7.07", "6 to 8", "2", "2, 1"]


def test_a_method_that_failed_shows_no_figures():
    assert compared(Row("joint", None, None, failure="no"))[1:] == ["failed", *"-----"]


def test_the_table_shows_what_was_evaluated_and_no_empty_rows():
    expected = Deviations(np.array([[3.0, np.nan], [4.0, np.nan]]), np.full((2, 2), 1e-3))
    foretold = Foretold(HeldOut(expected, UNSEEN.folds, ()), UNSEEN)
    full = Unseen(UNSEEN, by_region=HeldOut(FITTED, ((0, 1),), ()), foretold=foretold)
    rows = [Summary("staged", FITTED, Unseen(UNSEEN)), Summary("joint", FITTED, full)]
    table = {name.strip(): cells for name, *cells in table_rows(rows)}
    assert table["held-out error, RMS"] == ["7.07 px", "7.07 px"]
    assert table["95 % of resampled views"] == ["6.00 to 8.00 px"] * 2
    assert table["held-out by region, RMS"] == ["-", "2.89 px"]
    # 6 and 8 where 3 and 4 were expected.
    assert table["over what the fit expected"] == ["-", "2.00"]
    assert "with a free pose a view" not in table
    assert len(table_rows([Summary("joint", FITTED, None)])) == 2


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


def test_the_errors_found_are_in_the_units_people_use():
    """A field that moves every tool by 2 mm along its x: some 20 px, left out or not."""
    scene = random_scene(0, 4, pixel_noise=0.0)
    noise = Noise(0.4, 1e-4, np.deg2rad(0.02), field=(1e-3, 1e-3), white_pixel=0.1)
    tried = (Alternative("trusted", 0.0, noise), Alternative("position", 31.4, noise))
    field = LinearInPosition.over(scene.data.base_from_tool)
    error = RobotError(field, jnp.full(18, 1e-3))
    bent = dataclasses.replace(scene.calibration, robot_error=error)
    sizes, none = (0.1, 0.2, 3.0), Doubt(*(np.zeros(0) for _ in Doubt._fields))
    estimate = NoiseEstimate("position", noise, field, bent, tried, False, sizes, (), none)
    trusting = fit_joint(scene.data, scene.calibration, noise="trusted")
    assert errors_found(trusting, scene.data) == []
    joint = dataclasses.replace(trusting, noise=noise, estimate=estimate, calibration=bent)
    lines = errors_found(joint, scene.data)
    assert lines[0][1].startswith("position; ")
    assert lines[0][1].endswith("trusted 0, position 31")
    assert "0.400 px +- 10% (within a view 0.100)" in lines[1][1]
    assert "0.100 mm +- 20% and 0.0200 deg" in lines[1][1]
    # The scene was made without any error: taking the field away leaves nothing.
    assert lines[2][0] == "without the correction"
    assert "0.00 px RMS" in lines[2][1]
    assert "still changing" in lines[3][1]
