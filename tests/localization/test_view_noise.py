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
from smartview_jax.localization.view_gains import noise_at_camera
from smartview_jax.simulation import paper_calibration

SIZES = np.array([1e-6, 1e-6, 1e-4, 2e-5, 1e-6, 1e-6])


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
@pytest.mark.parametrize("frame", ["tool", "base"])
def test_the_camera_moves_as_the_tool_errs(mount, frame):
    # Without a lever from the tool to the camera, which is not counted.
    turn = host_exponentials(np.array([0.0, 0.0, 0.0, 0.4, -0.3, 0.9]))
    paper = paper_calibration()
    calibration = Calibration(paper.camera, host_transforms(turn), paper.holder_from_world, mount)
    axes = np.diag(SIZES**2), np.zeros((6, 6))
    directions = PoseDirections.of(*(axes if frame == "tool" else axes[::-1]))
    noise = Noise(1.0, 1e-4, 1e-4, directions=directions)
    base_from_tool = host_exponentials(np.array([0.0, 0.0, 0.0, -0.2, 0.5, 0.1]))
    candidates = host_matrices(calibration.camera_from_world(host_transforms(base_from_tool)))
    found = noise_at_camera(noise, calibration, candidates[None])
    twists = SIZES * np.random.default_rng(0).normal(size=(5_000, 6))
    if frame == "base":
        inverse = base_from_tool[:3, :3].T
        twists = np.concatenate([twists[:, :3] @ inverse.T, twists[:, 3:] @ inverse.T], axis=1)
    erring = host_matrices(
        calibration.camera_from_world(host_transforms(base_from_tool @ host_exponentials(-twists)))
    )
    drawn = np.cov(host_logarithms(erring @ np.linalg.inv(candidates)), rowvar=False)
    if mount == "eye_to_hand":
        # The target's lever is counted where it is: it moves the camera's translation.
        found, drawn = found[:, 3:, 3:], drawn[3:, 3:]
    np.testing.assert_allclose(found[0], drawn, atol=0.06 * np.abs(drawn).max())


def test_nothing_is_known_of_free_or_exact_poses():
    calibration, candidates = paper_calibration(), np.eye(4)[None]
    assert noise_at_camera(None, calibration, candidates) is None
    free = dataclasses.replace(Noise(1.0, 1.0, 1.0), rotation=np.inf)
    assert noise_at_camera(free, calibration, candidates) is None
