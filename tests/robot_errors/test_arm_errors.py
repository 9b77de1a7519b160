import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from field_programs import actual_pose, motion_between, own_jacobian, twists_by_differences
from jaxlie import SE3

from smartview_jax import Calibration
from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.robot_errors import (
    DHErrors,
    ElasticDHErrors,
    JointOffsets,
    JointRatios,
    RobotError,
)
from smartview_jax.robots import SerialArm, kuka_lwr4, six_axes

ARMS = [six_axes(), kuka_lwr4(), SerialArm(*np.eye(4, 3), prismatic=[False, True, False])]


@pytest.fixture(scope="module", params=[JointRatios, ElasticDHErrors])
def field(request):
    """Joint offsets alone are the first part of either, and all of `DHErrors` of the latter."""
    return request.param(six_axes())


@pytest.fixture(scope="module")
def error(field):
    return RobotError(field, jnp.asarray(1e-3 * np.random.default_rng(0).normal(size=field.size)))


@pytest.fixture(scope="module")
def joints():
    return np.random.default_rng(1).uniform(-1.0, 1.0, (5, 6))


@eqx.filter_jit
def camera_from_world(calibration, command):
    return calibration.camera_from_world(command)


def calibration_with(error, mount="eye_in_hand"):
    camera = Camera(800.0, 790.0, 321.0, 239.0, Pinhole(), (640, 480))
    transforms = SE3.exp(jnp.full(6, 0.1)), SE3.exp(jnp.full(6, -0.2))
    return Calibration(camera, *transforms, mount, robot_error=error)


def test_the_tool_is_where_the_corrected_numbers_put_it(joints):
    """An arm built with the wrong numbers, and the errors that make it the right one."""
    arm = six_axes()
    offset, d, a, alpha = 1e-3 * np.random.default_rng(2).normal(size=(4, 6))
    right = dataclasses.replace(
        arm, theta=arm.theta + offset, d=arm.d + d, a=arm.a + a, alpha=arm.alpha + alpha
    )
    error = RobotError(DHErrors(arm), jnp.concatenate([offset, d, a, alpha]))
    found, expected = actual_pose(error, arm.command(joints)), right.base_from_tool(joints)
    np.testing.assert_allclose(motion_between(found, expected), 0.0, atol=1e-13)


def test_a_joint_goes_its_ratio_times_its_reading_and_its_offset():
    arm = ARMS[2]
    offset, ratio = jnp.array([0.01, -0.02, 0.03]), jnp.array([0.1, -0.2, 0.05])
    readings = jnp.array([[0.3, -0.4, 0.5], [-1.0, 0.2, 0.7]])
    error = RobotError(JointRatios(arm), jnp.concatenate([offset, ratio]))
    expected = arm.base_from_tool(readings * (1.0 + ratio)[None] + offset[None])
    found = actual_pose(error, arm.command(readings))
    np.testing.assert_allclose(motion_between(found, expected), 0.0, atol=1e-13)


def test_a_joint_yields_to_the_weight_beyond_it():
    """By hand: two links of 1 m, level and at 60 degrees, about joints with axes along y."""
    arm = SerialArm([0.0, 0.0, 0.0], np.zeros(3), [0.0, 1.0, 1.0], [-np.pi / 2.0, 0.0, 0.0])
    compliances = np.array([0.0, 0.003, 0.002])
    error = RobotError(ElasticDHErrors(arm), jnp.concatenate([jnp.zeros(12), compliances]))
    reading = np.array([[0.0, 0.0, -np.pi / 3.0]])
    # Three equal masses: at the second joint, after 1 m and after 1.5 m. Levers are in parts of
    # half of their number times the reach of 2 m; turns by +y lower the arm.
    levers = np.array([0.0, 1.0 + 1.5, 0.5]) / (1.5 * 2.0)
    expected = arm.base_from_tool(reading + compliances * levers)
    found = actual_pose(error, arm.command(reading))
    np.testing.assert_allclose(motion_between(found, expected), 0.0, atol=1e-13)
    assert found.translation()[0, 2] < arm.base_from_tool(reading).translation()[0, 2]


def test_a_command_keeps_readings_within_their_limits(joints):
    """What a joint goes may pass the limit that its reading keeps."""
    readings = joints * 0.9
    arm = dataclasses.replace(six_axes(), limits=jnp.tile(jnp.array([-1.0, 1.0]), (6, 1)))
    error = RobotError(JointRatios(arm), jnp.concatenate([jnp.zeros(6), jnp.full(6, 0.3)]))
    assert np.abs(1.3 * readings).max() > 1.0
    told = error.command(actual_pose(error, arm.command(readings)), readings)
    np.testing.assert_allclose(told.joints, readings, atol=1e-7)


@pytest.mark.parametrize("kind", [JointRatios, ElasticDHErrors])
def test_the_smaller_field_is_the_first_part_of_the_larger(joints, kind):
    larger = kind(six_axes())
    smaller = larger.nested_fields[0]
    assert isinstance(smaller, JointOffsets)
    assert larger.groups[: len(smaller.groups)] == smaller.groups
    assert larger.names[: smaller.size] == smaller.names
    offsets = jnp.linspace(-1e-3, 1e-3, smaller.size)
    whole = jnp.zeros(larger.size).at[: smaller.size].set(offsets)
    command = larger.arm.command(joints)
    np.testing.assert_array_equal(
        smaller.actual_pose(command, offsets).wxyz_xyz, larger.actual_pose(command, whole).wxyz_xyz
    )


@pytest.mark.parametrize("arm", ARMS, ids=["six", "seven", "sliding"])
def test_no_errors_leave_the_pose_as_reported(arm):
    reported = arm.command(np.full((2, arm.joint_count), 0.3))
    for field in (*ElasticDHErrors(arm).nested_fields, JointRatios(arm)):
        found = RobotError.zero(field).actual_pose(reported)
        np.testing.assert_array_equal(found.wxyz_xyz, reported.base_from_tool.wxyz_xyz)


def test_names_count_joints_from_one(field):
    assert field.names[0] == "joint_offset.1"
    assert len(set(field.names)) == field.size
    groups = [name for name, count in field.groups for _ in range(count)]
    assert all(
        name.startswith(f"{group}.") for name, group in zip(field.names, groups, strict=True)
    )


def test_the_twist_of_each_coefficient_is_that_of_a_small_change(error, joints):
    command = error.field.arm.command(joints)
    expected = twists_by_differences(error, command)
    np.testing.assert_allclose(own_jacobian(error, command), expected, atol=1e-8)


def test_a_calibration_predicts_and_commands_through_the_arm(error, joints):
    mount = "eye_in_hand" if isinstance(error.field, JointRatios) else "eye_to_hand"
    arm, calibration = error.field.arm, calibration_with(error, mount)
    command = arm.command(joints)
    seen = camera_from_world(calibration, command)
    true = camera_from_world(calibration_with(None, mount), actual_pose(error, command))
    np.testing.assert_allclose(motion_between(seen, true), 0.0, atol=1e-13)
    near = joints + 0.03
    np.testing.assert_allclose(calibration.joints_for(seen, near), joints, atol=1e-7)
    told = calibration.command_for(seen, near=near)
    np.testing.assert_allclose(motion_between(told, command.base_from_tool), 0.0, atol=1e-8)


def test_what_cannot_be_reached_is_nan_not_a_pose(error):
    far = SE3.from_translation(jnp.tile(jnp.array([9.0, 0.0, 0.0]), (5, 1)))
    told = calibration_with(error).command_for(far, near=np.full((5, 6), 0.3))
    assert np.isnan(told.translation()).all()


def test_poses_alone_are_refused(error, joints):
    calibration, poses = calibration_with(error), six_axes().base_from_tool(joints)
    with pytest.raises(ValueError, match=r"give arm.command\(joints\) instead of a pose"):
        calibration.project(poses, np.zeros((1, 3)))
    with pytest.raises(ValueError, match="give near=joints"):
        calibration.command_for(poses)
    with pytest.raises(ValueError, match="knows no arm"):
        calibration_with(None).joints_for(poses, joints)
    bare = calibration.project(poses, np.zeros((1, 3)), corrected=False)[0]
    expected = calibration_with(None).project(poses, np.zeros((1, 3)))[0]
    np.testing.assert_array_equal(bare, expected)


def test_files_keep_the_arm(error, tmp_path):
    path, calibration = tmp_path / "calibration.yaml", calibration_with(error)
    calibration.save(path)
    assert eqx.tree_equal(Calibration.load(path), calibration)


def test_differentiable_through_the_inversion(joints):
    """The joints move against what the errors move: implicit differentiation, by hand."""
    arm = six_axes()
    coefficients = jnp.asarray(1e-3 * np.random.default_rng(0).normal(size=12))
    error, command = RobotError(JointRatios(arm), coefficients), arm.command(joints)
    wanted, along = actual_pose(error, command), jnp.ones(12)

    def told(coefficients):
        return RobotError(error.field, coefficients).command(wanted, joints).joints

    _, moved = jax.jvp(told, (coefficients,), (along,))
    ratios = error.field.joint_scale_factors(coefficients)
    corrected = error.field.actual_arm(coefficients)
    by_coefficients = np.asarray(own_jacobian(error, command)) @ np.asarray(along)
    for view in range(5):
        by_joints = np.asarray(corrected.jacobian(joints[view] * ratios) * ratios[None])
        np.testing.assert_allclose(by_joints @ moved[view], -by_coefficients[view], atol=1e-6)
