import dataclasses

import numpy as np
import pytest
from scipy.optimize import approx_fprime

from smartview_jax.modeling import TriangulatedPoints, angle, dimension

POINTS = np.array([[0.0, 0.01, 0.02], [0.05, 0.0, 0.01], [0.02, 0.04, 0.0], [np.nan] * 3])


@pytest.fixture
def features():
    """Points with errors of their own, and of a calibration that shifts and turns all of them."""
    rng = np.random.default_rng(0)
    roots = 1e-4 * rng.standard_normal((4, 3, 3))
    shift = np.tile(np.eye(3), (4, 1, 1))
    turn = np.stack([np.cross(np.eye(3), point).T for point in np.nan_to_num(POINTS)])
    return TriangulatedPoints(
        points=POINTS,
        picture_covariance=roots @ roots.swapaxes(1, 2),
        calibration_jacobian=np.concatenate([shift, turn], axis=2),
        calibration_covariance=np.diag([1e-3] * 3 + [1e-2] * 3) ** 2,
        calibration_names=tuple("abcdef"),
        residuals=np.zeros((2, 4, 2)),
        status=np.zeros(4, dtype=int),
    )


def test_a_length_and_its_deviation(features):
    actual = dimension(features, 0, 1)
    assert actual.value == pytest.approx(np.linalg.norm(POINTS[1] - POINTS[0]))
    # A common shift or turn leaves a length as it is: only the points' own errors remain.
    u = (POINTS[1] - POINTS[0]) / actual.value
    own = features.picture_covariance[0] + features.picture_covariance[1]
    assert actual.std == pytest.approx(np.sqrt(u @ own @ u), rel=1e-6)
    # As if the calibration's errors were each point's own, it would be far worse.
    apart = features.covariance()[0] + features.covariance()[1]
    assert np.sqrt(u @ apart @ u) > 5.0 * actual.std


def test_an_angle_and_its_deviation(features):
    def value(flat):
        a, c, b = flat.reshape(3, 3)
        return np.arccos((a - c) @ (b - c) / np.linalg.norm(a - c) / np.linalg.norm(b - c))

    actual = angle(features, 2, 0, 1)
    chosen = POINTS[[2, 0, 1]].ravel()
    gradient = approx_fprime(chosen, value, 1e-8)
    assert actual.value == pytest.approx(value(chosen))
    expected = np.sqrt(gradient @ features.joint_covariance([2, 0, 1]) @ gradient)
    assert actual.std == pytest.approx(expected, rel=1e-4)


def test_what_cannot_be_measured_is_named(features):
    with pytest.raises(ValueError, match="vertex 3 was not determined"):
        dimension(features, 0, 3)
    with pytest.raises(ValueError, match="different vertices"):
        dimension(features, 1, 1)
    with pytest.raises(ValueError, match="no vertex 7"):
        dimension(features, 0, 7)
    same = dataclasses.replace(features, points=POINTS[[0, 0, 2, 3]])
    with pytest.raises(ValueError, match="same place"):
        dimension(same, 0, 1)
    line = dataclasses.replace(features, points=np.outer([0.0, 1.0, 2.0, 0.0], [1.0, 0.0, 0.0]))
    with pytest.raises(ValueError, match="on one line"):
        angle(line, 0, 1, 2)
