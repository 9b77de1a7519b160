"""Joints by iteration within limits, and the one entry for all arms."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from host_poses import motion_between
from jaxlie import SE3

from smartview_jax.robots import (
    SolutionStatus,
    joints_for_pose,
    kuka_lwr4,
    puma_560,
    six_axes,
    solve_joints_iteratively,
)

JOINTS = np.array([0.3, -0.5, 0.7, 0.2, 0.9, -0.4, 0.1])


def limited(bound=2.0):
    return dataclasses.replace(kuka_lwr4(), limits=np.tile([-bound, bound], (7, 1)))


def solved(arm, pose, near):
    """The answer for one pose, as one of `(2, 3)`: all tests of an arm share this program."""
    poses = SE3(np.tile(np.asarray(pose.wxyz_xyz), (2, 3, 1)))
    solution = joints_for_pose(arm, poses, np.tile(near, (2, 3, 1)))
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[1, 2]), solution)


def with_limits(arm, joint, bounds):
    limits = np.array(arm.limits)
    limits[joint] = bounds
    return dataclasses.replace(arm, limits=limits)


def test_limits_that_are_not_met_change_nothing():
    arm, near = limited(), JOINTS + 0.1
    solution = solved(arm, arm.base_from_tool(JOINTS), near)
    assert solution.is_solved
    assert not arm.violated_limits(solution.joints).any()
    left = motion_between(arm.base_from_tool(solution.joints), arm.base_from_tool(JOINTS))
    np.testing.assert_allclose(left, 0.0, atol=1e-9)


@pytest.mark.parametrize(
    "bounds", [(-0.2, 0.2), (-0.2, np.inf), (-np.inf, 0.2)], ids=["both", "lower", "upper"]
)
def test_joints_stay_within_their_limits(bounds):
    """An arm with a joint to spare goes round the limit that its free answer passes."""
    free = kuka_lwr4()
    sign = -1.0 if bounds[1] == np.inf else 1.0
    start = np.array([0.3, 0.5, 0.15 * sign, -1.0, 0.2, 0.8, 0.1])
    pose = free.base_from_tool(start + np.array([0.0, 0.0, 0.3 * sign, 0.0, 0.2, 0.1, 0.0]))
    loose = solved(free, pose, start)
    assert loose.is_solved
    assert abs(loose.joints[2]) > 0.2
    tight = with_limits(free, 2, bounds)
    solution = solved(tight, pose, start)
    assert solution.is_solved
    assert not tight.violated_limits(solution.joints).any()
    left = motion_between(tight.base_from_tool(solution.joints), pose)
    np.testing.assert_allclose(left, 0.0, atol=1e-9)


def test_a_search_may_begin_at_a_limit_or_beyond_it():
    arm = limited()
    goal = arm.base_from_tool(JOINTS)
    for first in (2.0, 5.0):
        near = JOINTS.copy()
        near[4] = first
        solution = solved(arm, goal, near)
        assert solution.is_solved
        assert not arm.violated_limits(solution.joints).any()


def test_what_stands_in_the_way_is_named():
    arm = with_limits(limited(3.0), 3, [-0.5, 0.5])
    bent = JOINTS.copy()
    bent[3] = 1.5  # the elbow alone sets how far the wrist is
    solution = solved(arm, arm.base_from_tool(bent), JOINTS * 0.5)
    assert solution.status_text() == "out of limits: joint 4"
    assert np.isnan(solution.joints).all()
    far = solved(kuka_lwr4(), SE3.from_translation(jnp.array([3.0, 0.0, 0.0])), JOINTS)
    assert far.status_text().startswith("out of reach")


def test_a_singular_answer_says_so():
    arm, straight = kuka_lwr4(), JOINTS.copy()
    straight[3] = 0.0
    solution = solved(arm, arm.base_from_tool(straight), straight)
    assert solution.is_solved
    assert int(solution.status) & SolutionStatus.SINGULAR
    assert solved(arm, arm.base_from_tool(JOINTS), JOINTS).status_text() == "ok"


def test_the_closed_form_is_taken_where_there_is_one():
    """It alone knows which joints are singular, and gives the nearest of all its solutions."""
    arm, far = puma_560(), np.array([0.3, 0.6, -0.8, 0.5, 0.7, 1.0])
    solution = joints_for_pose(arm, arm.base_from_tool(far), far + 0.6)
    np.testing.assert_allclose(solution.joints, far, atol=1e-9)
    far[4] = 0.0
    solution = joints_for_pose(arm, arm.base_from_tool(far), far)
    assert solution.status_text().startswith("singular wrist")
    np.testing.assert_allclose(solution.joints, far, atol=1e-9)


def test_an_arm_that_jit_hides_is_solved_by_iteration():
    arm, joints = puma_560(), np.array([0.3, 0.6, -0.8, 0.5, 0.7, 1.0])

    def moved(length):
        longer = dataclasses.replace(arm, a=arm.a.at[1].add(length))
        return joints_for_pose(longer, arm.base_from_tool(joints), joints).joints

    actual = jax.jit(moved)(0.01)
    longer = dataclasses.replace(arm, a=arm.a.at[1].add(0.01))
    left = motion_between(longer.base_from_tool(actual), arm.base_from_tool(joints))
    np.testing.assert_allclose(left, 0.0, atol=1e-9)


def test_many_poses_at_once():
    arm = limited()
    joints = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 3, 7))
    solution = joints_for_pose(arm, arm.base_from_tool(joints), joints + 0.02)
    assert solution.status.shape == (2, 3)
    assert solution.is_solved.all()


@jax.jit
def joints_and_derivatives(arm, pose, start, shift):
    """Joints for a pose and a shift of it, and their derivatives, forward and reverse."""

    def found(shift):
        moved = SE3.from_translation(shift) @ pose
        return solve_joints_iteratively(arm, moved, start)[0]

    joints, linear = jax.linearize(found, shift)
    transposed = jax.linear_transpose(linear, shift)
    forward = jax.vmap(linear, out_axes=1)(jnp.eye(3))
    return joints, forward, jax.vmap(transposed)(jnp.eye(6))[0]


@pytest.mark.parametrize("beyond", [0.0, 1.0], ids=["in reach", "out of reach"])
def test_derivatives_are_those_of_differences(beyond):
    """Out of reach the residual is not zero, and its second derivatives count."""
    start = np.array([0.3, 0.6, -0.8, 0.5, 0.7, 1.0])
    arm = dataclasses.replace(six_axes(), limits=np.tile([-3.0, 3.0], (6, 1)))
    pose = SE3.from_translation(jnp.array([beyond, 0.0, 0.0])) @ arm.base_from_tool(start)

    def found(shift):
        return joints_and_derivatives(arm, pose, start + 0.05, shift)

    joints, forward, reverse = found(np.zeros(3))
    left = motion_between(arm.base_from_tool(joints), pose)
    assert (np.abs(left).max() < 1e-8) == (beyond == 0.0)
    # Also where no joints lead to the pose, these are the nearest.
    assert np.linalg.norm(left) < beyond + 1e-8
    step = 1e-3 * np.eye(3)
    expected = np.stack([(found(s)[0] - found(-s)[0]) / 2e-3 for s in step], axis=1)
    np.testing.assert_allclose(forward, expected, atol=2e-3 * np.abs(expected).max())
    np.testing.assert_allclose(reverse, forward, atol=1e-9 * np.abs(expected).max())
