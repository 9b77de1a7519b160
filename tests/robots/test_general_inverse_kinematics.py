"""Joints by iteration within limits, and the one entry for all arms."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3

from smartview_jax.robots import (
    SolutionStatus,
    joints_for_pose,
    kuka_lwr4,
    nearest_puma_joints,
    puma_560,
    six_axes,
    solve_joints_iteratively,
)

JOINTS = np.array([0.3, -0.5, 0.7, 0.2, 0.9, -0.4, 0.1])


def limited(bound=2.0):
    return dataclasses.replace(kuka_lwr4(), limits=jnp.tile(jnp.array([-bound, bound]), (7, 1)))


def test_limits_that_are_not_met_change_nothing():
    arm, near = limited(), JOINTS + 0.1
    joints, reached = solve_joints_iteratively(arm, arm.base_from_tool(JOINTS), near)
    assert reached
    assert not arm.violated_limits(joints).any()
    left = arm.base_from_tool(joints).inverse() @ arm.base_from_tool(JOINTS)
    np.testing.assert_allclose(left.log(), 0.0, atol=1e-9)


@pytest.mark.parametrize(
    "bounds", [(-0.2, 0.2), (-0.2, np.inf), (-np.inf, 0.2)], ids=["both", "lower", "upper"]
)
def test_joints_stay_within_their_limits(bounds):
    """An arm with a joint to spare goes round the limit that its free answer passes."""
    free = kuka_lwr4()
    sign = -1.0 if bounds[1] == np.inf else 1.0
    start = np.array([0.3, 0.5, 0.15 * sign, -1.0, 0.2, 0.8, 0.1])
    pose = free.base_from_tool(start + np.array([0.0, 0.0, 0.3 * sign, 0.0, 0.2, 0.1, 0.0]))
    loose, reached = solve_joints_iteratively(free, pose, start)
    assert reached
    assert abs(loose[2]) > 0.2
    tight = dataclasses.replace(free, limits=free.limits.at[2].set(jnp.array(bounds)))
    joints, reached = solve_joints_iteratively(tight, pose, start)
    assert reached
    assert not tight.violated_limits(joints).any()
    left = (tight.base_from_tool(joints).inverse() @ pose).log()
    np.testing.assert_allclose(left, 0.0, atol=1e-9)


def test_a_search_may_begin_at_a_limit_or_beyond_it():
    arm = limited()
    goal = arm.base_from_tool(JOINTS)
    for first in (2.0, 5.0):
        near = JOINTS.copy()
        near[4] = first
        joints, reached = solve_joints_iteratively(arm, goal, near)
        assert reached
        assert not arm.violated_limits(joints).any()


def test_what_stands_in_the_way_is_named():
    arm = dataclasses.replace(
        kuka_lwr4(), limits=limited(3.0).limits.at[3].set(jnp.array([-0.5, 0.5]))
    )
    bent = JOINTS.copy()
    bent[3] = 1.5  # the elbow alone sets how far the wrist is
    found = joints_for_pose(arm, arm.base_from_tool(bent), JOINTS * 0.5)
    assert found.status_text() == "out of limits: joint 4"
    assert np.isnan(found.joints).all()
    far = joints_for_pose(kuka_lwr4(), SE3.from_translation(jnp.array([3.0, 0.0, 0.0])), JOINTS)
    assert far.status_text().startswith("out of reach")


def test_a_singular_answer_says_so():
    arm, straight = kuka_lwr4(), JOINTS.copy()
    straight[3] = 0.0
    found = joints_for_pose(arm, arm.base_from_tool(straight), straight)
    assert found.is_solved
    assert int(found.status) & SolutionStatus.SINGULAR
    assert joints_for_pose(arm, arm.base_from_tool(JOINTS), JOINTS).status_text() == "ok"


def test_the_closed_form_is_taken_where_there_is_one():
    arm, far = puma_560(), np.array([0.3, 0.6, -0.8, 0.5, 0.7, 1.0])
    pose = arm.base_from_tool(far)
    near = far + 0.6  # iteration need not arrive at the nearest
    found = joints_for_pose(arm, pose, near)
    expected = eqx.filter_jit(nearest_puma_joints)(arm, pose, near)
    np.testing.assert_array_equal(found.joints, expected.joints)
    hidden = jax.jit(lambda a: joints_for_pose(six_axes(), pose, a).joints)(far)
    assert np.isfinite(hidden).all() or np.isnan(hidden).all()


def test_an_arm_that_jit_hides_is_solved_by_iteration():
    arm, joints = puma_560(), np.array([0.3, 0.6, -0.8, 0.5, 0.7, 1.0])

    def moved(length):
        longer = dataclasses.replace(arm, a=arm.a.at[1].add(length))
        return joints_for_pose(longer, arm.base_from_tool(joints), joints).joints

    found = jax.jit(moved)(0.01)
    longer = dataclasses.replace(arm, a=arm.a.at[1].add(0.01))
    left = (longer.base_from_tool(found).inverse() @ arm.base_from_tool(joints)).log()
    np.testing.assert_allclose(left, 0.0, atol=1e-9)


def test_many_poses_at_once():
    arm = limited()
    joints = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 3, 7))
    found = joints_for_pose(arm, arm.base_from_tool(joints), joints + 0.02)
    assert found.status.shape == (2, 3)
    assert found.is_solved.all()


@pytest.mark.parametrize("beyond", [0.0, 1.0], ids=["in reach", "out of reach"])
def test_derivatives_are_those_of_differences(beyond):
    """Out of reach the residual is not zero, and its second derivatives count."""
    arm, start = six_axes(), np.array([0.3, 0.6, -0.8, 0.5, 0.7, 1.0])
    limited = dataclasses.replace(arm, limits=3.0 * jnp.array([[-1.0, 1.0]] * 6))
    pose = SE3.from_translation(jnp.array([beyond, 0.0, 0.0])) @ arm.base_from_tool(start)

    @jax.jit
    def found(shift):
        moved = SE3.from_translation(shift) @ pose
        return solve_joints_iteratively(limited, moved, start + 0.05)[0]

    forward, reverse = jax.jit(lambda x: (jax.jacfwd(found)(x), jax.jacrev(found)(x)))(np.zeros(3))
    step = 1e-3 * np.eye(3)
    expected = np.stack([(found(s) - found(-s)) / 2e-3 for s in step], axis=1)
    np.testing.assert_allclose(forward, expected, atol=2e-3 * np.abs(expected).max())
    np.testing.assert_allclose(reverse, forward, atol=1e-9 * np.abs(expected).max())
