import dataclasses

import jax.numpy as jnp
import numpy as np

from smartview_jax.evaluation import (
    UNCORRECTED_SUFFIX,
    Method,
    compare,
    count_rejected,
    free_pose_errors,
    held_out,
    rejected_by,
    reprojection_errors,
    standard_methods,
)
from smartview_jax.robot_errors import LinearInPosition, RobotError


class Fit:
    def __init__(self, calibration, rejected=()):
        self.calibration = calibration
        self.rejected = rejected


def test_a_row_holds_what_the_method_did_alone(scene):
    calls = []

    def fitter(data):
        calls.append(data)
        return Fit(scene.calibration, (("3", 5, "far off"), ("4", None, "no points")))

    said = []
    methods = {"first": fitter, "again": Method(fitter, lambda fit, _: fit.calibration)}
    first, again = compare(scene.data, methods, progress=said.append)
    assert len(calls) == 6  # all views, then five folds; methods with one fitter share them
    assert said[0] == "first"
    assert "first: fold 5 of 5" in said
    assert first.fitted.rms == reprojection_errors(scene.calibration, scene.data).rms
    assert first.held_out.folds == held_out(scene.data, fitter).folds
    assert count_rejected(first.rejected) == (1, 1)
    assert again.rejected is None
    np.testing.assert_array_equal(first.held_out.errors.px, again.held_out.errors.px)


def test_a_fit_with_a_correction_has_a_row_without_it(scene):
    """In some folds it found none; the bound by free poses has no chain to correct."""
    field = LinearInPosition.from_poses(scene.data.base_from_tool)
    error = RobotError(field, jnp.full(field.size, 1e-3))
    bent = dataclasses.replace(scene.calibration, robot_error=error)
    fitter = lambda data: bent if np.asarray(data.visible)[3].any() else scene.calibration  # noqa: E731
    methods = {
        "joint": Method(fitter),
        "free": Method(fitter, measure=free_pose_errors),
        "plain": lambda _: scene.calibration,
    }
    rows = compare(scene.data, methods)
    assert [row.name for row in rows] == ["joint", f"joint, {UNCORRECTED_SUFFIX}", "free", "plain"]
    joint, bare, _, plain = rows
    np.testing.assert_array_equal(bare.held_out.errors.px, plain.held_out.errors.px)
    assert joint.fitted.rms > 10.0 * bare.fitted.rms == 10.0 * plain.fitted.rms


def test_a_method_that_fails_says_why_and_the_others_go_on(scene):
    def fails(_):
        raise ValueError("cannot")

    bad, good = compare(scene.data, {"bad": fails, "good": lambda _: scene.calibration})
    assert (bad.fitted, bad.held_out, bad.failure) == (None, None, "cannot")
    assert good.failure is None


def test_a_fit_that_cannot_tell_rejected_nothing_known():
    assert rejected_by(object()) is None


def test_the_standard_methods_are_the_papers_and_the_joint_fit():
    methods = standard_methods("pinhole")
    for name in ("staged", "staged, no distortion", "linear interpolation", "joint, robot trusted"):
        assert name in methods
    assert methods["staged"].fitter is methods["joint, robot trusted"].fitter
