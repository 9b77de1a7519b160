import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from field_programs import actual_pose, motion_between, tool_command
from jaxlie import SE3, SO3

from smartview_jax import Calibration
from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.robot_errors import DHErrors, GenericSixAxisArm, RobotError
from smartview_jax.robot_errors.generic_six_axis_arm import MAX_POSE_REACH_FRACTION
from smartview_jax.robots import as_command, puma_joints, six_axes
from smartview_jax.robots.puma_inverse_kinematics import BRANCHES
from smartview_jax.simulation import six_axis_scene


@pytest.fixture(scope="module")
def poses():
    """As an arm reports them that looks down at a table."""
    return six_axis_scene(0, views=12, held_out_views=4).data.base_from_tool


@pytest.fixture(scope="module", params=[None, *BRANCHES[:2]], ids=["usual", "own", "own, flipped"])
def error(request, poses):
    """Of usual proportions, and of an arm that is known, with its wrist this way and that."""
    if request.param is None:
        field = GenericSixAxisArm.from_poses(poses)
    else:
        field = GenericSixAxisArm.from_poses(poses, arm=six_axes(), branch=request.param)
    sizes = np.repeat([1e-3, 5e-4, 1e-3], [count for _, count in field.groups])
    rng = np.random.default_rng(1)
    return RobotError(field, jnp.asarray(sizes * rng.normal(size=field.size)))


def test_the_field_is_the_arms_own_error_at_the_joints_that_poses_imply(error, poses):
    field = error.field
    branch = BRANCHES.index(tuple(np.asarray(field.branch).astype(int)))
    joints = np.asarray(puma_joints(field.arm, poses).joints)[:, branch]
    known = RobotError(DHErrors(field.arm), error.coefficients)
    expected = actual_pose(known, field.arm.command(joints))
    found = actual_pose(error, poses)
    np.testing.assert_allclose(motion_between(expected, found), 0.0, atol=1e-12)
    assert field.names == known.field.names
    moved = np.abs(motion_between(poses, found)).max(axis=0)
    assert (moved > 1e-4).all()


def test_without_errors_poses_are_as_reported(error, poses):
    found = actual_pose(RobotError.zero(error.field), poses)
    np.testing.assert_allclose(motion_between(poses, found), 0.0, atol=1e-13)


def test_true_and_reported_poses_are_each_others_inverse(error, poses):
    back = tool_command(error, actual_pose(error, poses))
    np.testing.assert_allclose(motion_between(poses, back), 0.0, atol=1e-12)


def test_the_farthest_pose_is_well_within_reach(poses):
    arm = GenericSixAxisArm.from_poses(poses).arm
    farthest = np.linalg.norm(poses.translation(), axis=1).max()
    reach = float(arm.a[0] + arm.a[1] + arm.d[3])
    assert farthest / reach == pytest.approx(MAX_POSE_REACH_FRACTION)
    assert np.asarray(puma_joints(arm, poses).is_solved)[:, 0].all()


@pytest.mark.parametrize("axis", ["x", "-x", "y", "-y", "z", "-z"])
def test_the_axis_asked_for_is_the_last_joints(poses, axis):
    arm = GenericSixAxisArm.from_poses(poses, axis).arm
    along = np.zeros(3)
    along["xyz".index(axis[-1])] = -1.0 if axis[0] == "-" else 1.0
    np.testing.assert_allclose(arm.flange_from_tool.apply(along), [0.0, 0.0, 1.0], atol=1e-15)


def test_an_axis_that_is_none_is_named(poses):
    with pytest.raises(ValueError, match=r"approach is one of z, -z, x.*found 'up'"):
        GenericSixAxisArm.from_poses(poses, "up")


def test_beyond_its_reach_the_arm_is_stretched_out_and_turns_the_hand(error):
    """Where it ends its errors go on; with none, poses are as reported."""
    far = SE3.from_rotation_and_translation(
        SO3.from_x_radians(jnp.tile(jnp.array([3.0, 2.5]), 6)),
        jnp.tile(jnp.array([[9.0, 1.0, 0.5], [0.0, 0.0, 0.0]]), (6, 1)),
    )
    moved = np.abs(motion_between(far, actual_pose(error, far)))
    assert 1e-5 < moved.max() < 0.02
    none = actual_pose(RobotError.zero(error.field), far)
    np.testing.assert_allclose(motion_between(far, none), 0.0, atol=1e-13)


@eqx.filter_jit
def slope_of_height(error, poses):
    """The derivative of how high the tools are by where they are said to be, and their poses."""

    def height(shift):
        moved = (SE3.from_translation(shift) @ poses).wxyz_xyz
        found = jax.vmap(lambda x: error.actual_pose(SE3(x)).wxyz_xyz)(moved)
        return jnp.sum(found[:, 6]), found

    return jax.grad(height, has_aux=True)(jnp.zeros(3))


def test_works_under_jit_vmap_and_grad(error, poses):
    slope, one_by_one = slope_of_height(error, poses)
    np.testing.assert_allclose(one_by_one, actual_pose(error, poses).wxyz_xyz, atol=1e-13)

    def height(shift):
        moved = SE3(poses.wxyz_xyz.at[:, 4:].add(jnp.asarray(shift)))
        return np.sum(actual_pose(error, moved).wxyz_xyz[:, 6])

    step = 1e-6 * np.eye(3)
    expected = [(height(s) - height(-s)) / 2e-6 for s in step]
    np.testing.assert_allclose(slope, expected, atol=1e-6)


def test_extent_is_one_at_about_the_edge(poses):
    field = GenericSixAxisArm.from_poses(poses)
    edge = SE3.from_translation(field.centre + jnp.array([0.0, 1.0, 0.0]) * field.reach)
    assert float(field.normalised_distance(as_command(edge))) == pytest.approx(1.0)


def test_files_keep_the_error_of_a_generic_arm(error, tmp_path):
    camera = Camera(800.0, 790.0, 321.0, 239.0, Pinhole(), (640, 480))
    mount = SE3.exp(jnp.full(6, 0.1))
    calibration = Calibration(camera, mount, mount, "eye_in_hand", 1.0, error)
    path = tmp_path / "calibration.yaml"
    calibration.save(path)
    loaded = Calibration.load(path)
    assert type(loaded.robot_error.field) is GenericSixAxisArm
    for one, other in zip(jax.tree.leaves(loaded), jax.tree.leaves(calibration), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-15)
