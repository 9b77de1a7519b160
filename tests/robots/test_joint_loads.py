import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartview_jax.robots import SerialArm, gravity_loads, kuka_lwr4, six_axes

MODIFIED = SerialArm(
    [0.1, 0.2, -0.4],
    [0.2, 0.1, 0.3],
    [0.0, 0.3, 0.2],
    [0.5, -1.0, 0.7],
    "modified",
    flange_from_tool=np.block([[np.eye(3), np.ones((3, 1))], [np.zeros((1, 3)), 1.0]]),
)


@pytest.mark.parametrize(
    "arm", [six_axes(), kuka_lwr4(), MODIFIED], ids=["six", "seven", "modified"]
)
def test_the_torque_is_the_slope_of_the_potential_energy(arm):
    """Equal masses at the ends of the links, by differences of how high they are in all."""
    count = arm.joint_count
    joints = np.random.default_rng(0).uniform(-1.0, 1.0, (4, count))
    steps = 1e-5 * np.array([np.eye(count), -np.eye(count)])
    moved = (joints[:, None, None] + steps).reshape(-1, count)
    origins = np.asarray(arm.frame_origins(moved)).reshape(4, 2, count, -1, 3)
    # There are two origins for each joint: a link ends where the next joint's screw about z begins.
    first = 2 if arm.convention == "standard" else 3
    ends = [*range(first, 2 * count, 2), 2 * count]
    height = origins[..., ends, 2].sum(axis=-1)
    torque = -(height[:, 0] - height[:, 1]) / 2e-5
    lengths = np.hypot(arm.a, arm.d).sum()
    reach = lengths + np.linalg.norm(arm.flange_from_tool.translation())
    np.testing.assert_allclose(
        gravity_loads(arm, jnp.asarray(joints)), torque / (0.5 * count * reach), atol=1e-9
    )


def test_an_arm_has_the_same_loads_in_both_conventions():
    zeros, a, alpha = np.zeros(3), [0.3, 0.5, 0.2], [-np.pi / 2.0, 0.4, 0.3]
    standard = SerialArm(zeros, zeros, a, alpha)
    last_link = np.eye(4)
    last_link[:3, :3] = Rotation.from_euler("x", alpha[2]).as_matrix()
    last_link[0, 3] = a[2]
    shifted = [0.0, *a[:2]], [0.0, *alpha[:2]]
    modified = SerialArm(zeros, zeros, *shifted, "modified", flange_from_tool=last_link)
    joints = jnp.asarray(np.random.default_rng(0).uniform(-1.0, 1.0, (4, 3)))
    np.testing.assert_allclose(
        gravity_loads(modified, joints), gravity_loads(standard, joints), atol=1e-12
    )


def test_loads_have_a_derivative_by_an_arm_whose_tool_is_its_flange():
    gradient = jax.grad(lambda arm: gravity_loads(arm, jnp.ones(6)).sum(), allow_int=True)(
        six_axes()
    )
    assert np.isfinite(gradient.flange_from_tool.wxyz_xyz).all()


def test_an_arm_that_is_stretched_out_loads_its_base_by_about_one():
    arm = SerialArm(np.zeros(10), np.zeros(10), np.full(10, 0.1), [np.pi / 2.0, *np.zeros(9)])
    loads = np.asarray(gravity_loads(arm, jnp.zeros(10)))
    # The first axis is upright.
    assert loads[0] == 0.0
    assert abs(abs(loads[1]) - 0.9) < 0.05


def test_slides_and_arms_without_length_have_no_load():
    slides = SerialArm(*np.eye(4, 3), prismatic=[True, True, True])
    np.testing.assert_array_equal(gravity_loads(slides, jnp.ones(3)), 0.0)
    head = SerialArm(np.zeros(2), np.zeros(2), np.zeros(2), [np.pi / 2.0, 0.0])
    np.testing.assert_array_equal(gravity_loads(head, jnp.ones(2)), 0.0)
