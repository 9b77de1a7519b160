"""Errors that follow the axes of tool and base, against errors that are drawn."""

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from smartview_jax import Noise
from smartview_jax.engine import PoseDirections

TOOL, BASE = (np.diag(np.square(sizes)) for sizes in ([3.0, 1, 1, 0, 0, 1], [0.0, 0, 2, 1, 0, 0]))


def test_the_errors_of_a_pose_scatter_as_stated():
    """One part is drawn in the tool's frame, the other in the base's and turned into it."""
    noise = Noise(1.0, 1.0, 1.0, directions=PoseDirections.of(TOOL, BASE))
    tool_from_base = Rotation.random(3, random_state=0)
    rng = np.random.default_rng(1)
    (found,) = noise.pose_covariances(tool_from_base.as_matrix()[:1])
    in_tool, in_base = (
        np.sqrt(np.diagonal(part)) * rng.normal(size=(20_000, 6)) for part in (TOOL, BASE)
    )
    turned = [tool_from_base[0].apply(in_base[:, part]) for part in (slice(0, 3), slice(3, 6))]
    drawn = np.cov(in_tool + np.concatenate(turned, axis=1), rowvar=False)
    np.testing.assert_allclose(found, drawn, atol=0.02 * np.abs(drawn).max())


def test_errors_alike_in_all_directions_have_two_sizes():
    noise = Noise(1.0, 2.0, 3.0)
    found = noise.pose_covariances(Rotation.random(2, random_state=0).as_matrix())
    expected = block_diag(4.0 * np.eye(3), 9.0 * np.eye(3))
    np.testing.assert_array_equal(found, np.stack([expected, expected]))


@pytest.mark.parametrize("wrong", [np.eye(5), -np.eye(6), np.eye(6) + np.eye(6, k=1)])
def test_what_is_no_covariance_is_refused(wrong):
    with pytest.raises(ValueError, match=r"PoseDirections.in_base: expected"):
        PoseDirections(*(tuple(map(tuple, part.tolist())) for part in (np.eye(6), wrong)))
