"""The sizes of noises of tracked poses, against closed forms and what was simulated."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import block_diag
from scipy.stats import norm
from tracked_scene import MOUNT, ROBOT, WORLD, data_of, turned

from smartview_jax.dataset import UNIT_TRANSLATION, PoseDataset
from smartview_jax.geometry import host_exponentials
from smartview_jax.variance import (
    LinearPairs,
    LogNormalPriors,
    averaged_covariance,
    likeliest_variances,
    linear_pairs,
)


def pairs_of(data, mount=MOUNT, world=WORLD):
    robot = np.asarray(data.base_from_tool.as_matrix())
    mount_from_holder = np.linalg.inv(robot) if data.mount == "eye_in_hand" else robot
    return linear_pairs(data, mount, mount_from_holder, world)


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
def test_the_derivatives_are_those_of_the_chain(mount):
    data, step = data_of(0, mount=mount), 1e-5 * np.arange(1.0, 13.0)
    by_mount, by_world = host_exponentials(step.reshape(2, 6))
    at, moved = pairs_of(data), pairs_of(data, by_mount @ MOUNT, by_world @ WORLD)
    np.testing.assert_allclose(
        at.errors - at.by_unknowns @ step, moved.errors, atol=1e-2 * np.abs(step).max()
    )


def test_one_noise_alone_has_the_variance_of_the_residuals():
    """The sum of squared residuals over the number of degrees of freedom."""
    pairs = pairs_of(data_of(0))
    one = LinearPairs(pairs.errors, pairs.by_unknowns, np.tile(1e-6 * np.eye(6), (1, 16, 1, 1)))
    columns, errors = one.by_unknowns.reshape(-1, 12), one.errors.ravel()
    rest = errors - columns @ np.linalg.lstsq(columns, errors, rcond=None)[0]
    found = likeliest_variances(one, np.ones(1)).variances
    assert 1e-6 * found[0] == pytest.approx(rest @ rest / (16 * 6 - 12), rel=1e-4)


def test_noise_along_the_line_of_sight_is_told_from_noise_across_it():
    rng, views = np.random.default_rng(0), 200
    seen = turned(rng.uniform(-0.6, 0.6, (views, 3)))
    seen[:, :3, 3] = rng.uniform([-0.2, -0.2, 0.4], [0.2, 0.2, 0.7], (views, 3))
    robot = np.linalg.inv(np.linalg.inv(MOUNT) @ seen @ np.linalg.inv(WORLD))
    robot = robot @ host_exponentials(rng.normal(size=(views, 6)) * np.repeat(ROBOT, 3))
    sight = seen[:, :3, 3] / np.linalg.norm(seen[:, :3, 3], axis=1, keepdims=True)
    measured = seen.copy()
    measured[:, :3, 3] += 5e-4 * rng.normal(size=(views, 3))
    measured[:, :3, 3] += 2e-3 * rng.normal(size=(views, 1)) * sight
    measured[:, :3, :3] = turned(2e-3 * rng.normal(size=(views, 3)))[:, :3, :3] @ seen[:, :3, :3]
    pairs = pairs_of(PoseDataset.from_poses(robot, measured))
    sizes = np.sqrt(likeliest_variances(pairs, np.ones(5)).variances)
    across, along = UNIT_TRANSLATION * sizes[:2]
    # Without priors the robot's noise takes a part of the tracker's.
    assert across == pytest.approx(5e-4, rel=0.25)
    assert along == pytest.approx(np.hypot(5e-4, 2e-3), rel=0.15)


def test_a_prior_decides_where_pairs_do_not():
    """Of two equal noises only the sum is known; the prior has one ten times the other."""
    pairs = pairs_of(data_of(0))
    twice = LinearPairs(pairs.errors, pairs.by_unknowns, np.tile(1e-6 * np.eye(6), (2, 16, 1, 1)))
    prior = LogNormalPriors(np.array([[1.0, -1.0]]), np.log([10.0]), np.array([0.1]))
    first, second = likeliest_variances(twice, np.ones(2), prior).variances
    assert np.sqrt(first / second) == pytest.approx(10.0, rel=0.01)


def one_noise_of(views, prior_std):
    """Pairs with one noise of unknown size, and its likeliest size with a prior about one."""
    pairs = pairs_of(data_of(0, views=views))
    parts = np.tile(1e-6 * np.eye(6), (1, views, 1, 1))
    one = LinearPairs(pairs.errors, pairs.by_unknowns, parts)
    prior = LogNormalPriors(np.eye(1), np.zeros(1), np.array([prior_std]))
    return one, likeliest_variances(one, np.ones(1), prior)


def test_the_density_of_some_poses_is_an_integral_over_unknowns_and_noise():
    """Gauss's integral over the unknowns, and SciPy's over the size of the noise."""
    one, found = one_noise_of(16, 0.5)
    columns, errors = one.by_unknowns.reshape(-1, 12), one.errors.ravel()
    rest = errors - columns @ np.linalg.lstsq(columns, errors, rcond=None)[0]
    freedom, shift = len(errors) - 12, 0.5 * np.log(1e-6)
    peak = 0.5 * np.log(rest @ rest / freedom) - shift

    def log_of(log_std):
        std = np.exp(log_std + shift)
        of_poses = -freedom * np.log(np.sqrt(2.0 * np.pi) * std) - 0.5 * rest @ rest / std**2
        return of_poses + norm.logpdf(log_std, scale=0.5)

    top = log_of(peak)
    mass = quad(lambda x: np.exp(log_of(x) - top), peak - 1.0, peak + 1.0)[0]
    expected = top + np.log(mass) - 0.5 * np.linalg.slogdet(columns.T @ columns)[1]
    assert found.evidence + found.log_density_over_evidence == pytest.approx(expected, abs=0.05)


def test_few_pairs_have_the_covariance_of_all_sizes_of_the_noise():
    """The mean of the variance by its posterior, integrated by SciPy; the best step is the same."""
    one, found = one_noise_of(4, 2.0)
    columns, errors = one.by_unknowns.reshape(-1, 12), one.errors.ravel()
    rest = errors - columns @ np.linalg.lstsq(columns, errors, rcond=None)[0]
    squares, freedom = rest @ rest / 1e-6, 4 * 6 - 12

    def density(log_std):
        return np.exp(
            -freedom * log_std - 0.5 * squares * np.exp(-2.0 * log_std) - 0.5 * (log_std / 2.0) ** 2
        )

    bounds = -4.0, 6.0
    total = quad(density, *bounds, epsabs=0.0)[0]
    mean = quad(lambda x: density(x) * np.exp(2.0 * x), *bounds, epsabs=0.0)[0] / total
    averaged = averaged_covariance(found)
    expected = mean * one.inverse(np.ones(1))
    np.testing.assert_allclose(averaged, expected, rtol=0.05, atol=1e-3 * expected.max())
    assert mean > 1.1 * found.variances[0]


def test_known_sizes_of_the_noise_add_nothing_to_the_covariance():
    """And cost no draws: the covariance is exactly the one of the likeliest sizes."""
    one, found = one_noise_of(16, 1e-3)
    expected = one.inverse(found.variances)
    np.testing.assert_allclose(averaged_covariance(found), expected, rtol=1e-8)
    # About another estimate, with its distance.
    distance = np.sqrt(np.diagonal(expected))
    about = one.solved(found.variances) - distance
    np.testing.assert_allclose(
        averaged_covariance(found, about), expected + np.outer(distance, distance), rtol=1e-6
    )


def test_the_information_is_the_curvature_of_the_likelihood():
    """At the maximum, on average over draws, half the second differences of the deviance."""
    rng, pairs = np.random.default_rng(0), pairs_of(data_of(0))
    columns, parts = pairs.by_unknowns, np.stack([pairs.parts[:2].sum(axis=0), pairs.parts[2]])
    root = np.linalg.cholesky(parts.sum(axis=0))
    curvature, information = np.zeros((2, 2)), np.zeros((2, 2))
    for _ in range(20):
        errors = np.einsum("vij,vj->vi", root, rng.standard_normal((16, 6)))
        found = likeliest_variances(LinearPairs(errors, columns, parts), np.ones(2))
        information += found.information / 20
        curvature += second_differences(errors, columns, parts, found.variances) / 20
    np.testing.assert_allclose(information, curvature, rtol=0.1, atol=0.02 * information.max())


def second_differences(errors, columns, parts, variances, step=1e-3):
    """Of half the restricted deviance by the logarithms of standard deviations, by SciPy."""
    J = columns.reshape(-1, columns.shape[2])

    def half_deviance(x):
        V = block_diag(*np.einsum("k,kvij->vij", variances * np.exp(2.0 * np.array(x)), parts))
        W = np.linalg.inv(V)
        normal = J.T @ W @ J
        e = errors.ravel()
        rest = e @ W @ e - e @ W @ J @ np.linalg.solve(normal, J.T @ W @ e)
        return 0.5 * (np.linalg.slogdet(V)[1] + np.linalg.slogdet(normal)[1] + rest)

    h = step * np.eye(2)
    return np.array(
        [
            [
                (
                    half_deviance(a + b)
                    - half_deviance(a - b)
                    - half_deviance(b - a)
                    + half_deviance(-a - b)
                )
                / (4.0 * step**2)
                for b in h
            ]
            for a in h
        ]
    )
