"""Good data are not refused because a robot is weak, or because three views close by chance."""

import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3

from smartview_jax.data_checks import check_conventions
from smartview_jax.geometry import as_se3, host_exponentials, host_matrices
from smartview_jax.simulation import paper_calibration, random_scene
from smartview_jax.simulation.scenes import random_viewpoints


@pytest.mark.parametrize("seed", [108, 251, 274])
def test_three_views_about_a_target_tell_no_unit_of_length(seed):
    """All from 0.2 m: any ratio of the motions closes, and some close better by chance."""
    truth, rng = paper_calibration(), np.random.default_rng(seed)
    camera_from_world = random_viewpoints(
        rng, 3, np.array([0.018, 0.015, 0.0]), (0.2, 0.2), np.deg2rad(35.0), 3.14
    )
    true = truth.command_for(camera_from_world)
    pose_noise = np.repeat([1e-4, np.deg2rad(0.01)], 3) * rng.standard_normal((3, 6))
    view_noise = np.array([2e-5, 2e-5, 3e-4, 1e-3, 1e-3, 2e-4]) * rng.standard_normal((3, 6))
    report = check_conventions(
        as_se3(host_matrices(true) @ host_exponentials(pose_noise)),
        as_se3(host_exponentials(view_noise) @ host_matrices(camera_from_world)),
        "eye_in_hand",
    )
    assert report.problems == ()


@pytest.mark.parametrize("seed", range(3))
def test_a_robot_with_two_degrees_of_noise_is_no_mistake(seed):
    scene = random_scene(seed, 20, translation_noise=1e-2, rotation_noise=np.deg2rad(2.0))
    seen = scene.calibration.camera_from_world(scene.base_from_tool)
    assert check_conventions(scene.data.base_from_tool, seen, "eye_in_hand").problems == ()
    shuffled = SE3(scene.data.base_from_tool.wxyz_xyz[jnp.roll(jnp.arange(20), 3)])
    assert check_conventions(shuffled, seen, "eye_in_hand").problems
