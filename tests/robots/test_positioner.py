"""The chain from the plate of a positioner to the tool of an arm."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartview_jax.robots import SerialArm, arm_with_positioner, puma_560, six_axes

TILT_AND_TURN = SerialArm([0.1, 0.0], [0.3, 0.05], [0.0, 0.02], [1.5, 0.0], "modified")
RAIL = SerialArm(
    [0.4], [0.1], [0.2], [0.3], prismatic=[True], limits=[[-1.0, 2.0]], flange_from_tool=np.eye(4)
)


@pytest.mark.parametrize("positioner", [TILT_AND_TURN, RAIL, six_axes()])
@pytest.mark.parametrize("arm", [six_axes(), puma_560()])
def test_the_tool_is_where_both_chains_put_it(arm, positioner):
    """By the two robots' own forward kinematics."""
    rng, place = np.random.default_rng(0), np.eye(4)
    place[:3, :3] = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    place[:3, 3] = rng.normal(size=3)
    both = arm_with_positioner(arm, positioner, place)
    of_positioner = rng.uniform(-1.0, 1.0, (5, positioner.joint_count))
    of_arm = rng.uniform(-1.0, 1.0, (5, arm.joint_count))
    plate = place @ np.asarray(positioner.base_from_tool(of_positioner).as_matrix())
    tool = np.asarray(arm.base_from_tool(of_arm).as_matrix())
    readings = np.hstack([of_positioner[:, ::-1], of_arm])
    actual = np.asarray(both.base_from_tool(readings).as_matrix())
    np.testing.assert_allclose(actual, np.linalg.inv(plate) @ tool, atol=1e-12)
    count = positioner.joint_count
    np.testing.assert_array_equal(both.limits[:count], positioner.limits[::-1])
    np.testing.assert_array_equal(both.limits[count:], arm.limits)
