"""The noise of a camera's pose in views that are only planned, against poses that err."""

import dataclasses

import numpy as np
import pytest

from smartview_jax import Calibration, Noise
from smartview_jax.engine import PoseDirections
from smartview_jax.geometry import (
    host_exponentials,
    host_logarithms,
    host_matrices,
    host_transforms,
)
from smartview_jax.localization.next_views.view_gains import noise_at_camera
from smartview_jax.simulation import paper_calibration

COVARIANCE = np.diag(np.array([1e-6, 1e-6, 1e-4, 2e-5, 1e-6, 1e-6]) ** 2)


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
@pytest.mark.parametrize("frame", ["tool", "base"])
def test_the_camera_moves_as_the_tool_errs(mount, frame):
    camera_from_mount = host_exponentials(np.array([0.05, -0.02, 0.1, 0.4, -0.3, 0.9]))
    paper = paper_calibration()
    calibration = Calibration(
        paper.camera, host_transforms(camera_from_mount), paper.holder_from_world, mount
    )
    parts = COVARIANCE, np.zeros((6, 6))
    directions = PoseDirections.of(*(parts if frame == "tool" else parts[::-1]))
    noise = Noise(1.0, 1e-4, 1e-4, directions=directions)
    base_from_tool = host_exponentials(np.array([0.4, 0.1, -0.3, -0.2, 0.5, 0.1]))
    candidate = host_matrices(calibration.camera_from_world(host_transforms(base_from_tool)))
    covariance = noise_at_camera(noise, calibration, candidate[None])
    assert covariance is not None
    step = 1e-6
    erring = base_from_tool @ host_exponentials(-step * np.eye(6))
    moved = host_matrices(calibration.camera_from_world(host_transforms(erring)))
    by_tool = host_logarithms(moved @ np.linalg.inv(candidate)).T / step
    if frame == "base":
        by_tool = by_tool @ np.kron(np.eye(2), base_from_tool[:3, :3].T)
    expected = by_tool @ COVARIANCE @ by_tool.T
    np.testing.assert_allclose(covariance[0], expected, atol=1e-5 * expected.max())


def test_nothing_is_known_of_free_or_exact_poses():
    calibration, candidates = paper_calibration(), np.eye(4)[None]
    assert noise_at_camera(None, calibration, candidates) is None
    free = dataclasses.replace(Noise(1.0, 1.0, 1.0), rotation=np.inf)
    assert noise_at_camera(free, calibration, candidates) is None
