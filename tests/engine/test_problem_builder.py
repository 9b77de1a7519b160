"""The problem of a joint fit has the priors that were asked for, centred where they belong."""

import dataclasses

import numpy as np
import pytest

from smartview_jax import Prior
from smartview_jax.dataset import PoseDataset
from smartview_jax.engine import build_problem
from smartview_jax.engine.parameters import parameter_names
from smartview_jax.simulation import random_scene


@pytest.mark.parametrize("tracked", [False, True])
def test_priors_without_a_mean_move_with_their_centre(tracked):
    scene = random_scene(0)
    start, data = scene.calibration, scene.data
    if tracked:
        poses = data.base_from_tool
        data = PoseDataset.from_poses(poses, start.camera_from_world(poses))
    given = {"camera.v0": Prior(std=1.0, mean=200.0), "camera.u0": Prior(std=1.0)}
    built = build_problem(data, start, priors=given | {"camera_from_tool": Prior(std=1e-3)})
    camera = dataclasses.replace(start.camera, u0=start.camera.u0 + 3.0, v0=start.camera.v0 + 4.0)
    centre = dataclasses.replace(
        start, camera=camera, camera_from_mount=start.camera_from_mount.inverse()
    )
    means = np.asarray(built.with_prior_centre(centre).problem.prior_mean.shared)
    mean = dict(zip(parameter_names(start, ()), means, strict=True))
    assert mean["camera.u0"] == float(camera.u0)
    assert mean["camera.v0"] == 200.0
    assert np.isnan(mean["camera.alpha_u"])
    np.testing.assert_allclose(
        [mean[f"camera_from_tool.translation.{axis}"] for axis in "xyz"],
        centre.camera_from_tool.translation(),
        atol=1e-15,
    )
