"""How far a stylus misses, against many draws of all errors, and against the simulated test."""

import numpy as np
import pytest
from scipy.stats import chi2

from smartview_jax import Calibration
from smartview_jax.evaluation import stylus_error, touching_pose
from smartview_jax.geometry import host_matrices, host_transforms
from smartview_jax.grasping import (
    ToolCommands,
    compare_misses,
    ellipse_axes,
    measured_error_factor,
    stylus_orientations,
    tip_error_factor,
    tool_commands,
)
from smartview_jax.grasping.stylus_touches import ELLIPSE_PROBABILITY, ELLIPSE_RADII
from smartview_jax.simulation import paper_calibration

TRUTH = paper_calibration()
TIP = np.array([0.01, -0.02, 0.15])
DOWN = np.array([np.diag([1.0, -1.0, -1.0]), [[0, 1, 0], [1, 0, 0], [0, 0, -1]]], dtype=float)


def poses():
    matrices = np.tile(np.eye(4), (2, 1, 1))
    matrices[:, :3, :3] = stylus_orientations(TIP, DOWN)
    rotations = host_transforms(matrices).rotation()
    return host_matrices(touching_pose(TIP, rotations, np.array([[0.0, 0, 0], [0.01, 0, 0]])))


def test_the_stylus_points_where_it_is_to():
    axis = TIP / np.linalg.norm(TIP)
    np.testing.assert_allclose(poses()[:, :3, :3] @ axis, DOWN[:, :, 2], atol=1e-12)
    np.testing.assert_allclose(
        poses()[:, :3] @ np.append(TIP, 1.0), [[0, 0, 0], [0.01, 0, 0]], atol=1e-12
    )
    np.testing.assert_allclose(stylus_orientations(np.zeros(3), DOWN), DOWN, atol=1e-12)


def test_a_small_error_moves_the_tip_as_in_the_simulated_test():
    """The commands of a wrong calibration, where the true one takes the tip."""
    tau = np.array([3e-5, -1e-5, 2e-5, 1e-5, 4e-5, -2e-5])
    touches = ToolCommands(poses(), None, np.tile(tau[:, None], (2, 1, 1)))
    actual = tip_error_factor(touches, TIP)[:, :, 0]
    # The tool is displaced: exp(tau) tool_from_world.
    error = stylus_error(TRUTH, TRUTH, TIP, host_transforms(poses()), np.tile(tau, (2, 1)))
    np.testing.assert_allclose(actual, np.asarray(error), atol=1e-8)


def test_an_ellipse_holds_what_it_says():
    rng = np.random.default_rng(0)
    covariance = np.array([[4.0, 1.5], [1.5, 1.0]])
    axes, directions = ellipse_axes(covariance)
    along = rng.multivariate_normal(np.zeros(2), covariance, 20000) @ directions / axes
    assert np.mean(np.sum(along**2, axis=1) < 1.0) == pytest.approx(0.95, abs=0.005)
    assert axes[0] > axes[1]


@pytest.mark.parametrize("size", [2, 3])
def test_misses_as_expected_are_called_so(size):
    """Most of the error is common to all touches, and the test of all knows it."""
    rng = np.random.default_rng(1)
    factor = np.concatenate(
        [np.tile(rng.normal(size=(1, 3, 6)), (4, 1, 1)), 0.1 * rng.normal(size=(4, 3, 12))], axis=2
    )
    p_values, inside = [], []
    for _ in range(400):
        misses = (factor @ rng.normal(size=18))[:, :size]
        comparison = compare_misses(factor, misses)
        p_values.append(comparison.p_value)
        inside.append(comparison.inside)
    # Uniform p-values: their mean is known to 0.014.
    assert np.mean(p_values) == pytest.approx(0.5, abs=0.05)
    assert np.mean(inside) == pytest.approx(0.95, abs=0.02)
    expected = np.sqrt(np.mean(np.sum(factor[:, :size] ** 2, axis=(1, 2))))
    assert comparison.expected_rms == pytest.approx(expected)
    assert comparison.chi_square == pytest.approx(chi2.isf(comparison.p_value, 4 * size))


def test_misses_that_are_larger_than_expected_are_called_so():
    factor = np.tile(1e-4 * np.eye(3), (3, 1, 1))
    comparison = compare_misses(factor, np.full((3, 3), 1e-3))
    assert comparison.p_value < 1e-6
    assert not comparison.inside.any()
    # All touches err by the same here: what differs between them cannot be.
    unequal = compare_misses(factor, np.array([[1e-5, 0, 0], [0, 0, 0], [0, 0, 0.0]]))
    assert unequal.chi_square == np.inf
    with pytest.raises(ValueError, match="expected 2 or 3 numbers for each of 3 touches"):
        compare_misses(factor, np.zeros((2, 3)))


def test_a_rough_ruler_and_a_tip_that_is_not_known_are_no_error_of_the_calibration():
    """Their covariance by the law of the propagation of errors, for each touch and between both."""
    touches = ToolCommands(poses(), None, np.full((2, 6, 1), 1e-6))
    exact = np.full((2, 6, 1), 0.0)
    factor = measured_error_factor(touches._replace(error_factor=exact), TIP, 3e-4, 2e-4)
    stacked = factor.reshape(6, -1)
    turns = poses()[:, :3, :3].reshape(6, 3)
    expected = 2e-4**2 * turns @ turns.T + 3e-4**2 * np.eye(6)
    np.testing.assert_allclose(stacked @ stacked.T, expected, atol=1e-16)
    misses = 3e-4 * np.array([[1.0, -1.0, 0.5], [-0.7, 0.2, 1.0]])
    assert compare_misses(tip_error_factor(touches, TIP), misses).p_value < 1e-6
    assert compare_misses(measured_error_factor(touches, TIP, 3e-4), misses).p_value > 0.05


def test_an_exact_calibration_expects_nothing():
    assert isinstance(TRUTH, Calibration)
    exact = tool_commands(TRUTH, poses())
    assert tip_error_factor(exact, TIP) is None
    assert measured_error_factor(exact, TIP, 1e-4) is None


@pytest.mark.parametrize("size", [2, 3])
def test_the_kept_radii_of_ellipses_are_scipys(size):
    assert ELLIPSE_RADII[size] ** 2 == pytest.approx(chi2.ppf(ELLIPSE_PROBABILITY, size), rel=1e-12)
