"""The Puma's models, and its closed-form inverse."""

import dataclasses
import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from host_poses import motion_between
from jaxlie import SE3

from smartview_jax.geometry import host_exponentials
from smartview_jax.robots import (
    SerialArm,
    SolutionStatus,
    general_inverse_kinematics,
    is_puma_like,
    joints_for_pose,
    kuka_lwr4,
    nearest_puma_joints,
    puma_560,
    puma_560_lee,
    puma_joints,
    six_axes,
)


def tooled(arm):
    """Another zero of every joint, a base, a tool, and a bent last link."""
    pose = host_exponentials(np.linspace(-0.3, 0.4, 6))
    return SerialArm(
        np.asarray(arm.theta) + np.linspace(0.2, -1.0, 6),
        arm.d,
        [*np.asarray(arm.a[:5]), 0.03],
        [*np.asarray(arm.alpha[:5]), 0.4],
        limits=arm.limits,
        flange_from_tool=pose,
        base_from_first=pose @ pose,
    )


def twisted():
    """Twists of joints 4 and 5 to the same side, a shoulder both aside and ahead."""
    right = 0.5 * np.pi
    return SerialArm(
        np.zeros(6),
        [0.1, 0.05, 0.1, -0.4, 0.0, 0.1],
        [0.08, 0.5, -0.05, 0.0, 0.0, 0.0],
        [-right, 0.0, -right, right, right, 0.3],
    )


ARMS = {
    "paul": puma_560(),
    "lee": puma_560_lee(),
    "tooled": tooled(puma_560()),
    "tooled_lee": tooled(puma_560_lee()),
    "six_axes": six_axes(),
    "twisted": twisted(),
}


all_joints = puma_joints
nearest_joints = joints_for_pose


def same_pose(actual, expected, atol):
    np.testing.assert_allclose(motion_between(actual, expected), 0.0, atol=atol)


def test_published_poses():
    """Of the toolboxes for Matlab (its wiki, "Arm robot examples") and Scilab (help of Ikine6s)."""
    zero, nominal = (
        puma_560()
        .base_from_tool(np.array([np.zeros(6), [0.0, np.pi / 4, np.pi, 0.0, np.pi / 4, 0.0]]))
        .as_matrix()
    )
    np.testing.assert_allclose(zero[:3, :3], np.eye(3), atol=1e-15)
    np.testing.assert_allclose(zero[:3, 3], [0.4521, -0.15005, 0.4318], atol=1e-9)
    turned = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    np.testing.assert_allclose(nominal[:3, :3], turned, atol=1e-15)
    np.testing.assert_allclose(nominal[:3, 3], [0.5963031, -0.15005, -0.0143543], atol=5e-8)


def test_a_published_answer_is_among_the_branches():
    """Scilab's help of Ikine6s, for the nominal pose; the limits there are none."""
    arm = dataclasses.replace(puma_560(), limits=np.tile([-np.inf, np.inf], (6, 1)))
    pose = arm.base_from_tool(np.array([0.0, np.pi / 4, np.pi, 0.0, np.pi / 4, 0.0]))
    published = [2.6485612, -3.9269908, 0.0939558, 2.5325594, 0.9743496, 0.3733996]
    off = np.asarray(all_joints(arm, pose).joints) - published
    off -= 2.0 * np.pi * np.round(off / (2.0 * np.pi))
    assert np.abs(off).max(axis=1).min() < 1e-7


def test_a_toolboxs_own_numbers():
    models = pytest.importorskip("roboticstoolbox.models.DH", exc_type=ImportError)
    theirs, arm = models.Puma560(), puma_560()
    joints = np.random.default_rng(0).uniform(-2.0, 2.0, (20, 6))
    pedestal = np.array([0.0, 0.0, theirs.links[0].d])
    for q, pose in zip(joints, arm.base_from_tool(joints).as_matrix(), strict=True):
        expected = np.asarray(theirs.fkine(q))
        np.testing.assert_allclose(pose[:3, :3], expected[:3, :3], atol=1e-12)
        np.testing.assert_allclose(pose[:3, 3] + pedestal, expected[:3, 3], atol=1e-12)
    np.testing.assert_allclose(arm.limits, theirs.qlim.T, atol=1e-12)


def test_the_two_models_are_one_arm_but_for_their_zeros():
    paul, lee = puma_560(), puma_560_lee()
    same = dataclasses.replace(
        paul, d=lee.d.at[2].set(lee.d[1]).at[1].set(0.0), a=lee.a.at[2].set(-lee.a[2])
    )
    joints = np.random.default_rng(1).uniform(-np.pi, np.pi, (50, 6))
    shift = np.pi * np.array([1, 1, -1, 0, 0, 1])
    # Two arms were measured, within 1.3 mm of each other; the flange's length is Lee's alone.
    for name in ("a", "d"):
        np.testing.assert_allclose(getattr(same, name)[:5], getattr(paul, name)[:5], atol=1.3e-3)
    same_pose(same.base_from_tool(joints + shift), lee.base_from_tool(joints), 1e-14)
    for k in (1, 2, 3, 4):  # the limits follow the map where it has no half turn of a free choice
        np.testing.assert_allclose(lee.limits[k] + shift[k], paul.limits[k], atol=1e-12)


@pytest.mark.parametrize("name", ARMS)
def test_every_branch_puts_the_tool_there_and_one_is_where_it_came_from(name):
    arm = ARMS[name]
    joints = np.random.default_rng(2).uniform(-np.pi, np.pi, (2000, 6))
    poses = arm.base_from_tool(joints)
    solution = all_joints(arm, poses)
    assert solution.joints.shape == (2000, 8, 6)
    there = np.isfinite(solution.joints).all(axis=-1)
    lost = (np.asarray(solution.status) & SolutionStatus.OUT_OF_REACH) != 0
    np.testing.assert_array_equal(there, ~lost)
    # Branches that do not reach are replaced, so that all arms have as many to compare.
    reached = np.where(there[..., None], solution.joints, joints[:, None])
    expected = np.broadcast_to(np.asarray(poses.wxyz_xyz)[:, None], (2000, 8, 7))
    same_pose(arm.base_from_tool(reached), SE3(jnp.asarray(expected)), 1e-9)
    off = np.asarray(solution.joints) - joints[:, None]
    off -= 2.0 * np.pi * np.round(off / (2.0 * np.pi))
    closest = np.nanmin(np.abs(off).max(axis=-1), axis=1)
    assert np.median(closest) < 1e-12
    assert closest.max() < 1e-6  # near the edges a root halves the digits


def test_the_branches_are_eight_different_arms():
    solution = all_joints(
        puma_560(), puma_560().base_from_tool(np.array([0.3, 0.6, -0.8, 1, 1, 1]))
    )
    turned = np.exp(1j * np.asarray(solution.joints))
    apart = np.abs(turned[:, None] - turned[None]).max(axis=-1)
    assert (apart + np.eye(8) > 1e-3).all()


def test_leading_axes_and_one_pose_agree():
    arm = puma_560()
    joints = np.random.default_rng(3).uniform(-1.0, 1.0, (2, 3, 6))
    poses = arm.base_from_tool(joints)
    together = all_joints(arm, poses)
    assert together.joints.shape == (2, 3, 8, 6)
    one = all_joints(arm, SE3(poses.wxyz_xyz[1, 2]))
    np.testing.assert_allclose(one.joints, together.joints[1, 2], atol=1e-12)
    np.testing.assert_array_equal(one.status, together.status[1, 2])


@jax.jit
def derivatives(arm, joints):
    """Return how a twist of the tool moves the nearest joints, both modes, and the Jacobian."""
    pose = arm.base_from_tool(joints)

    def nearest(twist):
        return nearest_puma_joints(arm, pose @ SE3.exp(twist), joints).joints

    _, linear = jax.linearize(nearest, jnp.zeros(6))
    transposed = jax.linear_transpose(linear, jnp.zeros(6))
    forward = jax.vmap(linear, out_axes=1)(jnp.eye(6))
    return forward, jax.vmap(transposed)(jnp.eye(6))[0], arm.jacobian(joints)


@pytest.mark.parametrize("name", ["paul", "lee", "six_axes", "twisted"])
def test_the_derivative_is_the_inverse_of_the_jacobian(name):
    arm, joints = ARMS[name], jnp.array([0.3, 0.6, -0.8, 0.5, 0.7, 1.0])
    forward, reverse, jacobian = map(np.asarray, derivatives(arm, joints))
    np.testing.assert_allclose(forward @ jacobian, np.eye(6), atol=1e-9)
    np.testing.assert_allclose(reverse, forward, atol=1e-11)


def test_a_straight_wrist_has_a_definite_answer_and_says_so():
    arm = tooled(puma_560())
    joints = jnp.array([0.3, 0.6, -0.8, 0.5, -arm.theta[4], 1.0])
    pose = arm.base_from_tool(joints)
    solution = nearest_joints(arm, pose, joints)
    assert int(solution.status) == SolutionStatus.WRIST_SINGULAR
    assert solution.is_solved
    assert solution.status_text().startswith("singular wrist")
    # Joint 4 is arbitrary there: it stays where it was, and zero where nothing is said.
    np.testing.assert_allclose(solution.joints, joints, atol=1e-9)
    assert 0.0 in all_joints(arm, pose).joints[:, 3]
    same_pose(arm.base_from_tool(solution.joints), pose, 1e-9)
    # A slope of another branch that is not finite would spoil the nearest branch's.
    forward, reverse, _ = derivatives(arm, joints)
    assert np.isfinite(forward).all()
    assert np.isfinite(reverse).all()


def test_a_wrist_a_little_off_straight_is_met_exactly():
    arm = puma_560()
    for small in (1e-12, 1e-9, 1e-8, 1e-7, 1e-5, 1e-3):
        pose = arm.base_from_tool(np.array([0.3, 0.6, -0.8, 0.5, small, 1.0]))
        joints = all_joints(arm, pose).joints
        expected = SE3(jnp.asarray(np.broadcast_to(pose.wxyz_xyz, (8, 7))))
        same_pose(arm.base_from_tool(joints), expected, 2e-9)


def test_a_stretched_arm_is_a_singular_elbow():
    arm = puma_560()
    straight = float(jnp.arctan2(-arm.d[3], arm.a[2]))  # the forearm on the upper arm's line
    pose = arm.base_from_tool(np.array([0.3, 0.6, straight, 0.5, 0.7, 1.0]))
    solution = all_joints(arm, pose)
    is_singular = (np.asarray(solution.status) & SolutionStatus.ELBOW_SINGULAR) != 0
    assert is_singular[4:].all() or is_singular[:4].all()
    view = int(np.argmax(is_singular))
    assert "singular elbow" in solution.status_text(view)
    there = np.isfinite(solution.joints).all(axis=-1)
    poses = SE3(jnp.asarray(np.broadcast_to(pose.wxyz_xyz, (there.sum(), 7))))
    same_pose(arm.base_from_tool(np.asarray(solution.joints)[there]), poses, 1e-9)


def test_a_wrist_above_the_shoulder_is_singular_and_nearer_out_of_reach():
    arm, turn = puma_560(), SE3.exp(jnp.array([0.0, 0.0, 0.0, 0.4, 0.2, 0.1])).rotation()
    side = float(arm.d[2])

    def at(distance):
        where = jnp.array([0.0, distance, 0.6])
        solution = all_joints(arm, SE3.from_rotation_and_translation(turn, where))
        return np.asarray(solution.status)

    assert (at(side) & SolutionStatus.SHOULDER_SINGULAR).all()
    assert (at(0.9 * side) == SolutionStatus.OUT_OF_REACH).all()
    assert not (at(1.1 * side) & SolutionStatus.SHOULDER_SINGULAR).any()
    # An arm without an offset: joint 1 may be anything, and is zero.
    over = all_joints(six_axes(), six_axes().base_from_tool(above_the_axis(six_axes())))
    assert (np.asarray(over.status) & SolutionStatus.SHOULDER_SINGULAR).any()


def above_the_axis(arm):
    """Joints that bring the wrist onto the first axis."""
    joints = np.array([0.7, 0.0, 0.0, 0.3, 0.5, 0.2])
    # The wrist's circle about the shoulder, with the elbow as it is.
    bare = dataclasses.replace(arm, d=arm.d.at[5].set(0.0))

    def ahead(q2):
        at = np.asarray(bare.base_from_tool(np.array([0.0, q2, *joints[2:]])).translation())
        return at[0]

    low, high = -1.0, 0.5
    assert ahead(low) * ahead(high) < 0.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if ahead(low) * ahead(middle) > 0.0 else (low, middle)
    return np.array([joints[0], middle, *joints[2:]])


def test_out_of_reach_is_nan_and_named():
    solution = nearest_joints(puma_560(), SE3.from_translation(jnp.array([2.0, 0, 0])), np.zeros(6))
    assert np.isnan(solution.joints).all()
    assert not solution.is_solved
    assert solution.status_text() == "out of reach"


def test_out_of_limits_names_the_joint_and_still_says_where():
    arm = puma_560()
    wide, joints = dataclasses.replace(arm, limits=np.tile([-3.2, 3.2], (6, 1))), np.zeros(6)
    narrow = dataclasses.replace(arm, limits=arm.limits.at[0].set(jnp.array([1.0, 1.1])))
    pose = arm.base_from_tool(joints + np.array([0.3, 0.6, -0.8, 0.5, 0.7, 1.0]))
    solution = nearest_joints(narrow, pose, joints)
    assert solution.status_text() == "out of limits: joint 1"
    assert not solution.is_solved
    same_pose(arm.base_from_tool(solution.joints), pose, 1e-9)
    assert nearest_joints(wide, pose, joints).is_solved


def test_an_answer_within_limits_comes_before_a_nearer_one_without():
    arm = puma_560()
    joints = np.array([0.3, 0.6, -0.8, 0.5, 0.7, 1.0])
    arm = dataclasses.replace(arm, limits=arm.limits.at[4].set(jnp.array([0.0, 1.5])))
    flipped = joints * [1, 1, 1, 1, -1, 1] + [0.0, 0.0, 0.0, np.pi, 0.0, np.pi]
    solution = nearest_joints(arm, arm.base_from_tool(joints), flipped)
    assert solution.is_solved
    assert solution.joints[4] > 0.0


@pytest.mark.parametrize(
    ("near", "expected"), [(0.0, 2.0), (-4.0, 2.0 - 2 * np.pi), (-9.0, 2.0 - 2 * np.pi)]
)
def test_the_nearest_turn_within_the_limits(near, expected):
    """The hand's joint turns by 266 degrees either way: two readings for most of its angles."""
    arm, joints = puma_560(), np.array([0.3, 0.6, -0.8, 0.5, 0.7, 2.0])
    close = joints.copy()
    close[5] = near
    solution = nearest_joints(arm, arm.base_from_tool(joints), close)
    assert solution.is_solved
    np.testing.assert_allclose(solution.joints[5], expected, atol=1e-9)


def test_a_joint_at_its_limit_is_within():
    arm = puma_560()
    joints = np.asarray(arm.limits[:, 1]).copy()
    joints[1:3] = 0.6, -0.8
    solution = nearest_joints(arm, arm.base_from_tool(joints), joints)
    assert solution.is_solved
    np.testing.assert_allclose(solution.joints, joints, atol=1e-9)


def test_other_arms_are_refused():
    skew = dataclasses.replace(puma_560(), alpha=puma_560().alpha.at[3].add(1e-3))
    offset = dataclasses.replace(puma_560(), a=puma_560().a.at[3].set(0.01))
    modified = dataclasses.replace(puma_560(), convention="modified")
    for arm in (kuka_lwr4(), skew, offset, modified):
        assert not is_puma_like(arm)
        with pytest.raises(ValueError, match="a Puma-like arm has six revolute joints"):
            puma_joints(arm, SE3.identity())
    assert is_puma_like(puma_560())


def test_the_program_that_solves_for_a_known_arm_can_be_kept():
    """A program that calls Python to raise would be compiled again in every process."""
    arm, joints = puma_560(), jnp.zeros(6)

    def calls_python(solve):
        text = eqx.filter_jit(solve).lower(arm, arm.base_from_tool(joints), joints).as_text()
        return "callback" in text

    assert not calls_python(inspect.unwrap(general_inverse_kinematics._closed_form_solution))
    assert calls_python(nearest_puma_joints), "within jit nobody knows the arm"
