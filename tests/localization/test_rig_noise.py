"""Errors of camera poses from objects that each view shows elsewhere, without pictures."""

import dataclasses
import tracemalloc

import numpy as np
import pytest
from drawn_edges import seen_views
from scipy.linalg import block_diag
from scipy.stats import multivariate_normal

from smartview_jax.geometry import host_adjoints, host_exponentials, host_logarithms
from smartview_jax.localization import rig_noise as module
from smartview_jax.localization.rig_noise import DEFAULT_PRIOR, PoseInView, rig_noise
from smartview_jax.modeling import CalibrationUncertainty

VIEWS = seen_views((0.0, 0.0, 0.0))
EXACT = CalibrationUncertainty.none(VIEWS)
UNCERTAIN = CalibrationUncertainty(("a", "b"), np.diag([4e-6, 9e-6]), np.zeros((2, 15, 2)), 2)
MANY = 10**6
"""Measurements from which a covariance is known."""


def seen_objects(rng, translation, rotation, count=4, numbers=0):
    """Poses of some objects in two views whose camera poses are off by random twists."""
    errors = rng.normal(size=(2, 6)) * np.repeat([translation, rotation], 3)
    objects = []
    for _ in range(count):
        pose = host_exponentials(rng.normal(scale=[0.05] * 3 + [1.0] * 3))
        seen = []
        for view, given in enumerate(VIEWS.camera_from_world):
            sigmas = rng.uniform(1.0, 3.0, 6) * np.repeat([2e-5, 4e-4], 3)
            in_camera = host_exponentials(errors[view]) @ given @ pose
            estimated = (
                np.linalg.inv(given) @ in_camera @ host_exponentials(sigmas * rng.normal(size=6))
            )
            by_camera = -host_adjoints(np.linalg.inv(given @ estimated))
            by_numbers = rng.normal(size=(6, numbers))
            covariance = np.diag(sigmas**2)
            seen.append(PoseInView(view, estimated, covariance, by_numbers, by_camera, MANY))
        objects.append(seen)
    return objects, errors


def disagreement(objects, uncertainty=EXACT, prior=DEFAULT_PRIOR):
    noise = rig_noise(objects, VIEWS, uncertainty, prior)
    assert noise is not None
    return noise.disagreement


def dense(seen, uncertainty, sizes):
    """Restricted log-likelihood of one object by all its differences, and the likeliest errors."""
    first, second = seen
    # The difference of the two poses contains all that does not depend on the object's pose.
    inverse = np.linalg.inv(first.world_from_object)
    y = host_logarithms(inverse @ second.world_from_object)
    by_errors = np.hstack(
        [first.by_calibration - second.by_calibration, first.by_camera, -second.by_camera]
    )
    prior = block_diag(uncertainty.covariance, np.diag(np.tile(np.repeat(sizes, 3), 2) ** 2))
    covariance = first.covariance + second.covariance + by_errors @ prior @ by_errors.T
    likeliest = prior @ by_errors.T @ np.linalg.solve(covariance, y)
    return multivariate_normal(np.zeros(6), covariance).logpdf(y), likeliest


@pytest.mark.parametrize("uncertainty", [EXACT, UNCERTAIN])
def test_restricted_likelihood_is_the_likelihood_of_the_differences(uncertainty):
    ((seen,), _) = seen_objects(
        np.random.default_rng(1), 1e-3, 5e-3, count=1, numbers=len(uncertainty.names)
    )
    equations = module._equations(seen, VIEWS, uncertainty)
    sizes = np.array([[1e-4, 1e-3], [2e-3, 4e-3]])
    covariances = module._covariances(equations, uncertainty, sizes)
    first, second = module._log_likelihoods(equations.residuals, covariances)
    expected = [dense(seen, uncertainty, size)[0] for size in sizes]
    # The likelihoods agree but for a constant.
    assert first - second == pytest.approx(expected[0] - expected[1])
    noise = rig_noise([seen], VIEWS, uncertainty)
    assert noise is not None
    likeliest = dense(seen, uncertainty, (noise.translation, noise.rotation))[1]
    np.testing.assert_allclose(noise.errors.ravel(), likeliest[-12:], rtol=1e-6, atol=1e-9)


def test_many_objects_take_no_more_memory_than_a_few():
    """Covariances of all their residuals, one for each size, would have 250 MB."""
    objects, _ = seen_objects(np.random.default_rng(7), 1e-3, 5e-3, count=60)
    tracemalloc.start()
    noise = rig_noise(objects, VIEWS, EXACT)
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()
    assert noise is not None
    assert noise.disagreement.is_likely


def test_a_right_rig_is_as_stated_and_a_wrong_one_is_not():
    for seed in range(5):
        rng = np.random.default_rng(seed)
        assert disagreement(seen_objects(rng, 0.0, 0.0)[0]).as_stated > 0.5
        assert disagreement(seen_objects(rng, 1e-3, 2e-3)[0]).as_stated < 1e-6


def test_relative_error_of_two_views_is_found():
    objects, errors = seen_objects(np.random.default_rng(3), 2e-3, 8e-3)
    noise = disagreement(objects)
    first, second = host_exponentials(errors) @ VIEWS.camera_from_world
    a, b = VIEWS.camera_from_world
    twist = host_logarithms(first @ np.linalg.inv(second) @ b @ np.linalg.inv(a))
    assert noise.views == (0, 1)
    assert noise.turn == pytest.approx(np.linalg.norm(twist[3:]), rel=0.02)
    assert noise.shift == pytest.approx(np.linalg.norm(twist[:3]), rel=0.05)
    assert noise.is_unusual(0.95)


def test_known_noise_of_the_robot_explains_as_large_a_difference():
    objects, _ = seen_objects(np.random.default_rng(4), 1e-3, 5e-3, numbers=12)
    # The numbers are the errors of both views themselves.
    known = np.diag(np.tile(np.repeat([1e-3, 5e-3], 3), 2) ** 2)
    names = tuple(map(str, range(12)))
    stated = CalibrationUncertainty(names, known, np.zeros((2, 15, 12)), 0)

    def of_both_views(measurement):
        of_view = np.eye(2)[measurement.view].repeat(6)
        return measurement._replace(by_calibration=of_view * np.tile(measurement.by_camera, 2))

    by_view = [[of_both_views(measurement) for measurement in seen] for seen in objects]
    assert not disagreement(by_view, stated).is_likely
    assert disagreement(by_view, stated._replace(covariance=1e-6 * known)).as_stated < 1e-6


def test_few_measurements_tell_less():
    objects, _ = seen_objects(np.random.default_rng(5), 1e-4, 1e-3, count=1)
    few = [[measurement._replace(freedom=3) for measurement in seen] for seen in objects]
    assert disagreement(few).as_stated > disagreement(objects).as_stated
    none = [[measurement._replace(freedom=2) for measurement in seen] for seen in objects]
    assert rig_noise(none, VIEWS, EXACT) is None


def test_an_arm_that_is_known_to_be_weak_has_usual_errors():
    objects, _ = seen_objects(np.random.default_rng(6), 2e-3, 8e-3)
    errors = dict(DEFAULT_PRIOR.group_medians)
    errors |= {"translation_by_position": 2e-2, "rotation_by_position": 4e-2}
    weak = dataclasses.replace(DEFAULT_PRIOR, group_medians=errors)
    assert not disagreement(objects, EXACT, weak).is_unusual(0.95)
