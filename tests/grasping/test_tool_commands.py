"""The tool arrives where Eq. 20 says, and its error is the world's own uncertainty."""

import dataclasses

import numpy as np
import pytest

from smartview_jax import Noise
from smartview_jax.engine import Observability
from smartview_jax.geometry import host_exponentials, host_matrices
from smartview_jax.grasping import tool_commands
from smartview_jax.joint import SavedEstimate
from smartview_jax.robots import puma_560
from smartview_jax.simulation import paper_calibration

CALIBRATION = paper_calibration()
WORLD_FROM_TOOL = host_exponentials(np.array([[0.02, -0.03, 0.1, 0.3, 2.0, -0.2]] * 2))
WORLD_FROM_TOOL[1, 2, 3] += 0.05


def estimate(noise=None, **std):
    """The paper's calibration, with standard deviations for some of its numbers."""
    names = tuple(name.replace("_at_", ".") for name in std)
    covariance = np.diag(np.square(list(std.values())))
    count = len(names)
    full = Observability(count, count, (), (), 1.0)
    return SavedEstimate(CALIBRATION, covariance, names, noise, 0.1, full)


def test_the_command_is_eq_20():
    tool = tool_commands(CALIBRATION, WORLD_FROM_TOOL)
    # base_from_tool = base_from_world @ world_from_object @ object_from_tool, all 4x4.
    expected = host_matrices(CALIBRATION.base_from_world) @ WORLD_FROM_TOOL
    np.testing.assert_allclose(host_matrices(tool.commands.base_from_tool), expected, atol=1e-9)
    assert tool.covariance is None
    assert tool.refusals() == ("", "")


def test_a_world_that_may_be_displaced_displaces_the_tool():
    known = estimate(
        base_from_world_at_translation_at_x=1e-3,
        base_from_world_at_translation_at_y=1e-3,
        base_from_world_at_translation_at_z=1e-3,
    )
    tool = tool_commands(CALIBRATION, WORLD_FROM_TOOL, estimate=known)
    covariance = tool.covariance
    assert covariance is not None
    np.testing.assert_allclose(covariance[0, :3, :3], 1e-6 * np.eye(3), atol=1e-15)
    np.testing.assert_allclose(covariance[:, 3:], 0.0, atol=1e-15)
    # The world's displacement is the same at both poses.
    assert tool.error_factor is not None
    both = tool.error_factor[:, :3]
    np.testing.assert_allclose(both[0], both[1], atol=1e-12)


def test_a_world_that_may_be_turned_displaces_by_the_lever_arm():
    known = estimate(base_from_world_at_rotation_at_z=1e-3)
    tool = tool_commands(CALIBRATION, WORLD_FROM_TOOL, estimate=known)
    covariance = tool.covariance
    assert covariance is not None
    # The turn is about the world's origin, with an axis along the base's z.
    base_from_world = host_matrices(CALIBRATION.base_from_world)
    arms = WORLD_FROM_TOOL[:, :3, 3] @ base_from_world[:3, :3].T
    expected = 1e-3 * np.hypot(arms[:, 0], arms[:, 1])
    actual = np.sqrt(np.trace(covariance[:, :3, :3], axis1=1, axis2=2))
    np.testing.assert_allclose(actual, expected, rtol=1e-6)


def test_the_robots_noise_is_another_one_at_every_pose():
    noise = Noise(pixel=0.1, translation=2e-4, rotation=1e-9)
    tool = tool_commands(
        CALIBRATION,
        WORLD_FROM_TOOL,
        estimate=estimate(noise, base_from_world_at_translation_at_x=1e-9),
    )
    factor = tool.error_factor
    assert factor is not None
    np.testing.assert_allclose(np.trace(factor[0, :3] @ factor[0, :3].T), 3 * 4e-8, rtol=1e-4)
    assert np.abs(factor[0, :3] @ factor[1, :3].T).max() < 1e-12


def test_what_is_out_of_reach_is_said():
    far = WORLD_FROM_TOOL.copy()
    far[:, :3, 3] += 5.0
    near = np.deg2rad([0.0, 90.0, -90.0, 0.0, 60.0, 0.0])
    tool = tool_commands(CALIBRATION, far, arm=puma_560(), near=near)
    assert all("out of reach" in text for text in tool.refusals())
    with pytest.raises(ValueError, match="give near=joints"):
        tool_commands(CALIBRATION, far, arm=puma_560())
    next_to_arm = dataclasses.replace(CALIBRATION, mount="eye_to_hand")
    with pytest.raises(ValueError, match="camera on the hand"):
        tool_commands(next_to_arm, far)
