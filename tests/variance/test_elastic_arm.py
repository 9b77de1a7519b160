"""An arm that bends under its weight: its errors are curved, and the mount does not pay for it."""

import dataclasses

import numpy as np
import pytest
from elastic_arm import elastic_scene
from fit_scenes import MANY_VIEWS
from starts import nudged

from smartview_jax import Calibration, fit_joint
from smartview_jax.engine import with_lens
from smartview_jax.io import robot_urdf
from smartview_jax.joint.bending import bending_warnings

BENDING = 2.0
"""Twice the usual, so that sixteen views tell."""

MOUNT = tuple(f"camera_from_tool.translation.{axis}" for axis in "xyz")


def fit_of(scene):
    return fit_joint(scene.data, with_lens(nudged(scene.calibration), "opencv4"))


@pytest.fixture(scope="module")
def scene():
    return elastic_scene(1, MANY_VIEWS, BENDING)


@pytest.fixture(scope="module")
def unknown(scene):
    """The arm is known by its poses alone."""
    return fit_of(scene)


@pytest.fixture(scope="module")
def known(scene):
    """The arm is known by its joints."""
    return fit_of(scene.with_joint_readings)


def errors_and_widths(fit, scene):
    """The errors of the mount's position, and the half widths of its intervals, m."""
    found, true = (x.camera_from_tool.translation() for x in (fit.calibration, scene.calibration))
    return np.abs(found - true), [fit.confidence_half_width(name) for name in MOUNT]


def gains(fit):
    """Twice the log-likelihood of each model over white noise's, the target's size as stated."""
    candidates = fit.noise_estimate.candidates
    return {c.model.field: c.log_likelihood_ratio for c in candidates if not c.model.free_sizes}


def test_errors_that_are_quadratic_in_the_position_are_likelier_than_linear_ones(unknown, scene):
    assert unknown.noise_estimate.name == "position_squared"
    gain = gains(unknown)
    assert gain["position_squared"] > 10.0 + max(gain["position"], gain["six_axis_arm"])
    errors, widths = errors_and_widths(unknown, scene)
    assert (errors < widths).all()
    (said,) = [text for text in unknown.warnings if "error is curved" in text]
    assert "mm RMS from a straight line" in said


def test_a_curve_within_its_uncertainty_is_not_named(unknown):
    uncertain = dataclasses.replace(unknown, covariance=1e4 * unknown.covariance)
    assert any("curved" in text for text in bending_warnings(unknown))
    assert bending_warnings(uncertain) == []


def test_the_bending_of_a_known_joint_is_found_and_named(known, scene):
    """The shoulder's, which is 0.1 degrees at full reach for once the usual bending."""
    assert known.noise_estimate.name == "elastic_dh"
    gain = gains(known)
    assert gain["elastic_dh"] > 50.0 + gain["dh"]
    errors, widths = errors_and_widths(known, scene)
    assert (errors < widths).all()
    (said,) = [text for text in known.warnings if "the arm bends: joint 2 by" in text]
    degrees, std = map(float, said.split("joint 2 by ")[1].split(" degrees")[0].split(" +- "))
    assert abs(degrees - 0.1 * BENDING) < 4.0 * std < 0.1 * BENDING


def test_a_file_keeps_the_bending_and_a_urdf_refuses_it(known, tmp_path):
    path = tmp_path / "calibration.yaml"
    known.calibration.save(path)
    loaded = Calibration.load(path)
    np.testing.assert_array_equal(
        loaded.robot_error.coefficients, known.calibration.robot_error.coefficients
    )
    with pytest.raises(ValueError, match="joints were found to bend"):
        robot_urdf(known.calibration)


def test_a_rigid_arm_is_given_no_bending():
    fit = fit_of(elastic_scene(1, MANY_VIEWS, 0.0).with_joint_readings)
    assert fit.noise_estimate.name == "white"
    assert not any("bends" in text for text in fit.warnings)
