import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from standard_scene import POINTS, VIEWS

from smartview_jax import Noise, fit_joint, fit_staged
from smartview_jax.calibration_pipeline import CalibrationFit
from smartview_jax.evaluation import (
    HeldOutErrors,
    HeldOutReport,
    MethodResult,
    PredictedError,
    ReprojectionErrors,
    reprojection_errors,
)
from smartview_jax.fit_result import Rejection
from smartview_jax.report import (
    COMPARISON_HEADINGS,
    ErrorSummary,
    comparison_row,
    error_summaries,
    remarks,
    result_summary,
    table_rows,
)
from smartview_jax.report.tables import (
    _model_with_description,
    error_model_rows,
    model_counts_text,
    parameter_rows,
)
from smartview_jax.robot_errors import DHErrors, LinearInPosition, RobotError, RobotPrior
from smartview_jax.robots import six_axes
from smartview_jax.simulation import random_scene
from smartview_jax.variance import CandidateResult, ModelName, NoiseEstimate
from smartview_jax.variance.kenward_roger import SmallSampleCorrection

FITTED = ReprojectionErrors(np.array([[3.0, 4.0], [0.0, np.inf]]), np.full((2, 2), 1e-3))
UNSEEN = HeldOutErrors(
    ReprojectionErrors(np.array([[6.0, np.nan], [8.0, np.inf]]), np.full((2, 2), 2e-3)),
    ((0,), (1,)),
    ((1, "no pose"),),
    ((0, "ran out of steps"),),
)


def test_a_row_of_the_comparison_holds_the_figures():
    rejected = (Rejection("1", 5, "far"), Rejection("1", 6, "far"), Rejection("2", None, "empty"))
    row = comparison_row(MethodResult("joint", FITTED, UNSEEN, rejected))
    assert len(row) == len(COMPARISON_HEADINGS)
    # Mean and spread of 3, 4, 0; root mean square of the same, and of 6 and 8; mm at the target.
    # Drawing two views with replacement gives the one, the other, or both.
    assert row == ["joint", "2.33 +- 1.7", "2.89", "7.07", "6 to 8", "2", "2, 1"]


def test_a_method_that_failed_shows_no_figures():
    assert comparison_row(MethodResult("joint", None, None, failure="no"))[1:] == [
        "failed",
        *"-----",
    ]


def test_the_table_shows_what_was_evaluated_and_no_empty_rows():
    expected = ReprojectionErrors(np.array([[3.0, np.nan], [4.0, np.nan]]), np.full((2, 2), 1e-3))
    foretold = PredictedError(HeldOutErrors(expected, UNSEEN.folds, ()), UNSEEN)
    full = HeldOutReport(
        UNSEEN, by_region=HeldOutErrors(FITTED, ((0, 1),), ()), predicted_error=foretold
    )
    rows = [
        ErrorSummary("staged", FITTED, HeldOutReport(UNSEEN)),
        ErrorSummary("joint", FITTED, full),
    ]
    table = {name.strip(): cells for name, *cells in table_rows(rows)}
    assert table["held-out error, RMS"] == ["7.07 px", "7.07 px"]
    assert table["its 95 % interval over views"] == ["6.00 to 8.00 px"] * 2
    assert table["held-out by region, RMS"] == ["-", "2.89 px"]
    # 6 and 8 where 3 and 4 were expected.
    assert table["actual / predicted error (ideal: 1)"] == ["-", "2.00"]
    assert "with a free pose for each view" not in table
    assert len(table_rows([ErrorSummary("joint", FITTED, None)])) == 2


def test_remarks_say_what_the_figures_leave_out():
    assert remarks("joint", FITTED, HeldOutReport(UNSEEN)) == [
        "joint: 1 points seen cannot be predicted at all",
        "joint: 1 held-out points seen cannot be predicted at all",
        "joint: fold 2 failed: no pose",
        "joint: fold 1 did not converge: ran out of steps",
    ]
    outside = UNSEEN._replace(unconverged_folds=(), failures=(), extrapolated_views=(1,))
    assert remarks("linear interpolation", None, HeldOutReport(outside))[1:] == [
        "linear interpolation: 1 of 2 held-out views lie outside the hull of the remaining "
        "viewpoints: extrapolated"
    ]
    assert remarks("joint", None, None, "no pose at all") == ["joint: no pose at all"]
    whole = ReprojectionErrors(np.ones((1, 2)), np.ones((1, 2)))
    assert remarks("joint", whole, HeldOutReport(HeldOutErrors(whole, ((0,),), ()))) == []


def test_the_errors_found_are_in_the_units_people_use(moved_view):
    """A field that moves every tool by 2 mm along its x: some 20 px, left out or not."""
    scene = random_scene(0, VIEWS, POINTS, pixel_noise=0.0)
    noise = Noise(0.4, 1e-4, np.deg2rad(0.02), field=(1e-3, 1e-3), white_pixel=0.1)
    tried = (
        CandidateResult(ModelName("white"), 0.1, 0.0, noise),
        CandidateResult(ModelName("position"), 0.9, 31.4, noise),
    )
    field = LinearInPosition.from_poses(scene.data.base_from_tool)
    error = RobotError(field, jnp.full(18, 1e-3))
    bent = dataclasses.replace(scene.calibration, robot_error=error)
    sizes, none = (
        (0.1, 0.2, 3.0),
        SmallSampleCorrection(*(np.zeros(0) for _ in SmallSampleCorrection._fields)),
    )
    estimate = NoiseEstimate(
        "position",
        noise,
        field,
        field,
        bent,
        tried,
        None,
        None,
        None,
        None,
        False,
        sizes,
        (),
        none,
        np.zeros((0, 0)),
        RobotPrior(),
    )
    stated = moved_view[1].joint
    assert error_model_rows(stated, scene.data) == []
    joint = dataclasses.replace(stated, noise=noise, noise_estimate=estimate, calibration=bent)
    lines = error_model_rows(joint, scene.data)
    assert lines[0][1].startswith("position (smooth, linear in the tool's position); ")
    assert lines[0][1].endswith("probabilities: position 0.90, white 0.10")
    assert "0.400 px +- 10% (within a view 0.100)" in lines[1][1]
    assert "0.100 mm +- 20% and 0.0200 deg" in lines[1][1]
    # The scene was made without any error: taking the field away leaves nothing.
    assert lines[2][0] == "without the correction"
    assert "0.00 px RMS" in lines[2][1]
    assert "before they converged" in lines[3][1]


@pytest.fixture(scope="module")
def moved_view():
    """Views, one of them moved, with everything that is said of them."""
    scene = random_scene(3, VIEWS, POINTS, translation_noise=1e-4)
    poses = scene.data.base_from_tool.wxyz_xyz
    wrong = SE3(poses[6]) @ SE3.exp(jnp.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.02]))
    data = eqx.tree_at(
        lambda d: d.base_from_tool.wxyz_xyz, scene.data, poses.at[6].set(wrong.wxyz_xyz)
    )
    staged, noise = fit_staged(data), Noise(0.15, 1e-4, 1e-4)
    joint = fit_joint(
        data,
        staged.calibration,
        noise=noise,
        gross_errors="leave_out",
        inliers=staged.inliers,
    )
    return data, CalibrationFit.of(staged, joint, data)


def test_a_view_that_was_rejected_does_not_count(moved_view):
    data, fit = moved_view
    assert ("6", None) in [entry[:2] for entry in fit.rejected]
    rows = error_summaries(fit, data)
    without = data.mask_views([6])
    for row, part in zip(rows, (fit.staged, fit.joint), strict=True):
        assert row.reprojection_errors.rms == pytest.approx(
            reprojection_errors(part.calibration, without).rms
        )
        assert row.reprojection_errors.rms < 0.2 * reprojection_errors(part.calibration, data).rms
    text = result_summary(rows, fit)
    assert (
        f"{rows[1].reprojection_errors.rms:.2f} px RMS on the views that it was fitted to" in text
    )
    assert "Of 16 views 1 is rejected and not counted." in text
    assert "reliable" not in text


def test_few_views_are_called_few(moved_view):
    data, fit = moved_view
    few = data.mask_views(range(6, VIEWS))
    assert "With 6 views no figure here is reliable" in result_summary(
        error_summaries(fit, few), fit
    )


def test_without_a_single_good_fold_the_fitted_error_is_told(moved_view):
    data, fit = moved_view
    nothing = HeldOutErrors(
        ReprojectionErrors(*np.full((2, VIEWS, len(POINTS)), np.nan)), ((0,),), ((0, "no pose"),)
    )
    unseen = dict.fromkeys(("staged", "joint"), HeldOutReport(nothing))
    text = result_summary(error_summaries(fit, data, unseen), fit)
    assert "nan" not in text
    assert "on the views that it was fitted to" in text


def test_remarks_are_on_every_measure():
    floor = HeldOutErrors(FITTED, ((0,), (1,)), ((0, "no free pose"), (1, "no pose")))
    expected = HeldOutErrors(FITTED, ((0,), (1,)), ((0, "leaves something open"),))
    unseen = HeldOutReport(UNSEEN, UNSEEN, floor, PredictedError(expected, UNSEEN))
    found = remarks("joint", None, unseen)
    assert "joint: fold 2 failed: no pose" in found
    assert "joint, by region: fold 2 failed: no pose" in found
    assert found[-2:] == [
        "joint, with a free pose: fold 1 failed: no free pose",
        "joint, predicted error: fold 1 failed: leaves something open",
    ]


def test_what_folds_and_halves_took_the_error_for_is_counted():
    assert model_counts_text(["pose", "six_axis_arm", "six_axis_arm"]).endswith(
        "six_axis_arm 2, pose 1"
    )
    assert model_counts_text([]) == ""
    assert _model_with_description("pose") == "pose (smooth, linear in the tool's pose)"
    assert _model_with_description("Sag") == "Sag"


def test_an_arms_own_errors_are_parameters_in_its_units(moved_view):
    """Zeros in degrees, of a joint that slides in mm; of other fields nothing."""
    data, fit = moved_view
    arm = dataclasses.replace(six_axes(), prismatic=(False,) * 5 + (True,))
    error = RobotError(DHErrors(arm), jnp.full(24, 1e-3))
    bent = dataclasses.replace(fit.joint.calibration, robot_error=error)
    known = CalibrationFit.of(fit.staged, dataclasses.replace(fit.joint, calibration=bent), data)
    rows = {name: value for name, value, _ in parameter_rows(known)}
    assert rows["robot_error.joint_offset.1"] == "0.0572958 deg"
    assert rows["robot_error.joint_offset.6"] == "1 mm"
    assert rows["robot_error.link_length.a.2"] == "1 mm"
    assert rows["robot_error.link_twist.3"] == "0.0572958 deg"
    assert not any(name.startswith("robot_error") for name, _, _ in parameter_rows(fit))
