"""Errors along one line, as a small flat target's tilt has, count as one number and not as six."""

import numpy as np
from robot_motions import VIEWS, moving_alike
from scipy.spatial.transform import Rotation

from smartview_jax.data_checks import find_change, find_drift
from smartview_jax.data_checks.misfit_evidence import STRONG_EVIDENCE, errors_of, evidence
from smartview_jax.geometry import as_se3, host_exponentials

EVERY_VIEW = np.ones(VIEWS, dtype=bool)


def tilted(seed):
    """Poses of a small flat target that is seen tilted by a degree about one axis, by chance."""
    robot, camera = moving_alike(seed, noise=(1e-4, 0.01))
    tilts = np.random.default_rng(seed).normal(0.0, 1.0, VIEWS)
    turns = Rotation.from_rotvec(tilts[:, None] * [1.0, 0.0, 0.0], degrees=True)
    seen = camera.copy()
    seen[:, :3, :3] = camera[:, :3, :3] @ turns.as_matrix()
    return as_se3(robot), as_se3(seen)


def test_a_small_targets_tilt_is_no_change():
    """By chance it is larger after some view; alike in all directions that would be no chance."""
    assert not any(find_change(*tilted(seed), EVERY_VIEW) for seed in (7, 8, 27))


def test_a_small_targets_tilt_is_no_drift():
    assert not any(find_drift(*tilted(seed), EVERY_VIEW) for seed in (8, 29))


def test_errors_along_one_line_are_no_evidence_for_six_numbers():
    """A mean of 0.6 standard deviations along it is chance in twelve views; one of sixty is not."""
    rng = np.random.default_rng(0)
    direction = np.array([0.0, 5e-3, 0.0, 1e-2, 0.0, 0.0])
    errors = rng.normal(size=(12, 1)) * direction + rng.normal(0.0, 1e-5, (12, 6))
    centred = errors - errors.mean(axis=0)
    shifted = centred + 0.6 * direction
    given, left_over = (errors_of(host_exponentials(twists)) for twists in (shifted, centred))
    assert evidence(given, left_over, 6) < 0.0
    far = errors_of(host_exponentials(centred + 60.0 * direction))
    assert evidence(far, left_over, 6) > 2.0 * np.log(STRONG_EVIDENCE)
