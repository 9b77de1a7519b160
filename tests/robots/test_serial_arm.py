import dataclasses
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from host_poses import motion_between
from jaxlie import SE3
from shared_data import shared_data

from smartview_jax.robots import (
    ARMS,
    SerialArm,
    arm_from_dict,
    arm_to_dict,
    kuka_lwr4,
    six_axes,
)


def by_matrices(arm, joints):
    """The textbook's 4x4 matrices, multiplied one by one."""
    pose = np.eye(4)
    for theta, d, a, alpha in zip(
        np.asarray(arm.theta) + joints, arm.d, arm.a, arm.alpha, strict=True
    ):
        ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        if arm.convention == "standard":
            link = [
                [ct, -st * ca, st * sa, a * ct],
                [st, ct * ca, -ct * sa, a * st],
                [0.0, sa, ca, d],
            ]
        else:
            link = [
                [ct, -st, 0.0, a],
                [st * ca, ct * ca, -sa, -sa * d],
                [st * sa, ct * sa, ca, ca * d],
            ]
        pose = pose @ np.array([*link, [0.0, 0.0, 0.0, 1.0]])
    return pose @ np.asarray(arm.flange_from_tool.as_matrix())


def test_an_arm_is_made_without_compiling_a_program():
    with jax.no_execution():
        for arm in ARMS.values():
            arm()


def test_the_numbers_of_an_arm_are_copied():
    lengths = np.ones(6)
    arm = SerialArm(np.zeros(6), lengths, np.zeros(6), np.zeros(6))
    lengths[:] = 0.0
    np.testing.assert_array_equal(arm.d, np.ones(6))


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_forward_kinematics_are_the_textbooks(convention):
    rng = np.random.default_rng(0)
    tool = SE3.exp(jnp.asarray(rng.normal(size=6)))
    arm = SerialArm(*rng.normal(size=(4, 5)), convention=convention, flange_from_tool=tool)
    joints = rng.uniform(-np.pi, np.pi, (7, 5))
    actual = arm.base_from_tool(joints).as_matrix()
    np.testing.assert_allclose(actual, [by_matrices(arm, q) for q in joints], atol=1e-13)


def test_a_real_arms_reported_poses_follow_from_its_joints():
    folder = shared_data("lwr4_joint")
    reported = np.genfromtxt(folder / "poses.csv", delimiter=",", skip_header=1)
    joints = np.loadtxt(folder / "joint_angles.csv", delimiter=",")
    actual = np.asarray(kuka_lwr4().base_from_tool(joints).as_matrix())
    np.testing.assert_allclose(actual[:, :3], reported[:, 1:13].reshape(-1, 3, 4), atol=2e-4)


def test_a_sliding_joint_moves_along_its_axis():
    arm = SerialArm([0.3, 0.0], [0.1, 0.2], [0.0, 0.5], [0.0, 0.0], prismatic=[True, False])
    rest, moved = (arm.base_from_tool(jnp.array([x, 0.4])) for x in (0.0, 0.25))
    shift = moved.translation() - rest.translation()
    np.testing.assert_allclose(shift, [0.0, 0.0, 0.25], atol=1e-15)
    np.testing.assert_allclose(moved.rotation().wxyz, rest.rotation().wxyz, atol=1e-15)


def test_the_jacobian_is_the_twist_of_small_moves():
    arm, joints = six_axes(), jnp.array([0.3, -0.5, 0.7, 0.2, 0.9, -0.4])
    step = 1e-6
    here = SE3(np.tile(arm.base_from_tool(joints).wxyz_xyz, (6, 1)))
    shifts = step * np.eye(6)
    ahead, behind = (arm.base_from_tool(joints[None] + s * shifts) for s in (1.0, -1.0))
    twists = (motion_between(here, ahead) - motion_between(here, behind)) / (2.0 * step)
    jacobian = jax.jit(lambda joints: arm.jacobian(joints))(joints)
    np.testing.assert_allclose(jacobian, twists.T, atol=1e-9)


def test_works_under_jit_vmap_and_grad():
    arm = six_axes()
    joints = jnp.asarray(np.random.default_rng(1).normal(size=(3, 4, 6)))
    together = arm.base_from_tool(joints).wxyz_xyz
    one_by_one = jax.jit(jax.vmap(jax.vmap(lambda q: arm.base_from_tool(q).wxyz_xyz)))(joints)
    np.testing.assert_allclose(together, one_by_one, atol=1e-15)
    slope = jax.jit(jax.grad(lambda q: arm.base_from_tool(q).translation()[2]))(joints[0, 0])
    shifts = 1e-6 * np.eye(6)
    up, down = (arm.base_from_tool(joints[0, 0][None] + s * shifts) for s in (1.0, -1.0))
    heights = np.asarray(up.translation() - down.translation())[:, 2]
    np.testing.assert_allclose(slope, heights / 2e-6, atol=1e-8)


def test_readings_beyond_the_limits_are_told():
    arm = SerialArm(*np.zeros((4, 3)), limits=[[-1.0, 1.0], [-np.inf, 0.5], [-np.inf, np.inf]])
    actual = arm.violated_limits(np.array([[1.5, -9.0, 99.0], [-0.5, 0.6, 0.0]]))
    np.testing.assert_array_equal(actual, [[True, False, False], [False, True, False]])
    assert not six_axes().violated_limits(np.full(6, 1e3)).any()


def test_the_chain_begins_where_the_first_joint_is():
    arm, start = six_axes(), SE3.exp(jnp.arange(6.0) / 7.0)
    moved = dataclasses.replace(arm, base_from_first=start)
    joints = np.full((2, 6), 0.3)
    expected = start.as_matrix() @ arm.base_from_tool(joints).as_matrix()
    np.testing.assert_allclose(moved.base_from_tool(joints).as_matrix(), expected, atol=1e-15)


def test_files_keep_limits_and_ends_and_read_what_older_ones_lack():
    ends = {
        name: SE3.exp(scale * jnp.ones(6))
        for name, scale in (("flange_from_tool", 0.1), ("base_from_first", -0.2))
    }
    arm = SerialArm(*np.eye(4, 2), limits=[[-1.0, 1.0], [-np.inf, 0.5]], **ends)
    content = json.loads(json.dumps(arm_to_dict(arm), allow_nan=False))
    assert eqx.tree_equal(arm_from_dict(content), arm)
    older = {key: content[key] for key in ("theta", "d", "a", "alpha", "convention")}
    assert eqx.tree_equal(arm_from_dict(older), SerialArm(*np.eye(4, 2)))


def test_limits_can_be_kept_inside_jit():
    arm = SerialArm(*np.zeros((4, 1)), limits=[[-1.0, 1.0]])
    longer = eqx.filter_jit(lambda arm: dataclasses.replace(arm, a=arm.a + 1.0))(arm)
    np.testing.assert_array_equal(longer.limits, arm.limits)


def test_wrong_input_is_named():
    with pytest.raises(ValueError, match=r"limits: expected \(2, 2\).*found \(1, 2\)"):
        SerialArm(*np.zeros((4, 2)), limits=[[-1.0, 1.0]])
    with pytest.raises(ValueError, match=r"limits of joint 2: 1.0 is not below -1.0"):
        SerialArm(*np.zeros((4, 2)), limits=[[-1.0, 1.0], [1.0, -1.0]])
    with pytest.raises(ValueError, match="convention is one of standard, modified; found 'craig'"):
        SerialArm([0.0], [0.0], [0.0], [0.0], convention="craig")
    with pytest.raises(ValueError, match=r"one number per joint in each row; found .*'d': \(2,\)"):
        SerialArm([0.0], [0.0, 1.0], [0.0], [0.0])
    with pytest.raises(ValueError, match=r"joints: expected \(..., 6\).*found \(5,\)"):
        six_axes().base_from_tool(np.zeros(5))
