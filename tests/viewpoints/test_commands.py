import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from programs import programs_added

from smartview_jax import Calibration
from smartview_jax.geometry import five_viewpoints, look_at, se3_from_xyzoat
from smartview_jax.robot_errors import JointOffsets, LinearInPose, RobotError
from smartview_jax.robots import six_axes
from smartview_jax.simulation import paper_calibration, paper_points, random_viewpoints
from smartview_jax.viewpoints import ClearancePlane, Limits, predict, viewpoint_commands

POINTS = paper_points((0.0, 0.02))[::5]
CENTRE = POINTS.mean(axis=0)
FIVE = five_viewpoints(CENTRE, 0.2, roll=np.array([0.3, 0.0, -0.2, 0.5, 1.0]))
DOWN = np.array([0.0, 0.0, -1.0])


@pytest.fixture(scope="module")
def erring():
    """The paper's set-up, with a robot whose error was found from views around the target."""
    truth = paper_calibration()
    sampled = truth.command_for(
        random_viewpoints(np.random.default_rng(0), 40, CENTRE, (0.15, 0.3), 0.6)
    )
    field = LinearInPose.from_poses(sampled)
    size = 1e-3 * np.random.default_rng(1).normal(size=field.size)
    return dataclasses.replace(truth, robot_error=RobotError(field, jnp.asarray(size)))


@pytest.fixture(scope="module")
def arm_setting():
    """An arm with wrong zeros of its joints, and poses that it reaches."""
    arm = six_axes()
    joints = np.array([0.1, 0.4, 0.2, 0.1, -0.9, 0.0])
    flange_from_camera = paper_calibration().camera_from_tool.inverse()
    board = arm.base_from_tool(joints) @ flange_from_camera
    there = board @ SE3.from_translation(jnp.array([0.0, 0.0, 0.2]))
    turned = there @ look_at(CENTRE, DOWN, 0.0)
    calibration = Calibration.eye_in_hand(
        paper_calibration().camera, flange_from_camera.inverse(), turned
    )
    return calibration, arm, joints


def test_another_number_of_views_needs_no_other_programs(erring):
    five = viewpoint_commands(erring, FIVE, POINTS)
    three = jax.device_put(np.asarray(FIVE.wxyz_xyz)[:3])
    with programs_added() as added:
        commands = viewpoint_commands(erring, SE3(three), POINTS)
    assert added == []
    for few, all_views in (
        (commands.base_from_tool.wxyz_xyz, five.base_from_tool.wxyz_xyz),
        (commands.checks.measured["in_picture"], five.checks.measured["in_picture"]),
    ):
        np.testing.assert_array_equal(few, np.asarray(all_views)[:3])
    assert commands.predicted_views.camera_from_world.get_batch_axes() == (3,)


def test_the_camera_gets_where_it_is_wanted_with_the_robots_error_made_up_for(erring):
    commands = viewpoint_commands(erring, FIVE, POINTS)
    off = (commands.predicted_views.camera_from_world @ FIVE.inverse()).log()
    assert float(jnp.abs(off).max()) < 1e-12
    assert commands.checks.reasons() == ("",) * 5
    assert commands.joints is None
    # The bare chain would have commanded something else by more than the error's size.
    bare = erring.command_for(FIVE, corrected=False)
    assert float(jnp.abs((bare.inverse() @ commands.base_from_tool).log()).max()) > 1e-3
    again = se3_from_xyzoat(commands.xyzoat)
    np.testing.assert_allclose(again.as_matrix(), commands.base_from_tool.as_matrix(), atol=1e-12)


def test_what_is_predicted_is_the_whole_chain(erring):
    poses = erring.command_for(FIVE)
    views = predict(erring, poses)
    pixels, _ = views.camera.project(
        jax.vmap(lambda pose: SE3(pose).apply(jnp.asarray(POINTS)))(
            views.camera_from_world.wxyz_xyz
        )
    )
    np.testing.assert_allclose(pixels, erring.project(poses, POINTS)[0], atol=1e-9)
    # More than are taken at once, and in two dimensions.
    many = SE3(jnp.tile(poses.wxyz_xyz[None], (202, 1, 1)))
    spread = predict(erring, many).camera_from_world
    assert spread.get_batch_axes() == (202, 5)
    np.testing.assert_allclose(spread.wxyz_xyz[201], views.camera_from_world.wxyz_xyz, atol=1e-14)


def test_derivatives_of_the_command_are_those_of_differences():
    calibration = paper_calibration()

    def height(roll):
        wanted = look_at(jnp.asarray(CENTRE), jnp.array([0.2, 0.1, -1.0]), 0.2, roll)
        return viewpoint_commands(calibration, wanted).base_from_tool.translation()[2]

    heights, slopes = jax.vmap(jax.value_and_grad(height))(0.3 + jnp.array([-1e-5, 0.0, 1e-5]))
    assert float(slopes[1]) == pytest.approx(float(heights[2] - heights[0]) / 2e-5, rel=1e-6)


def test_what_is_wrong_with_a_view_is_said_in_words(erring):
    aim = CENTRE + np.array([0.0, 0.02, 0.0, 0.0, 0.9])[:, None] * np.array([1.0, 0.0, 0.0])
    wanted = look_at(aim, DOWN, np.array([0.2, 0.2, 0.12, 0.6, 0.2]))
    limits = Limits(border_margin=5.0, focus_range=(0.15, 0.4))
    checks = viewpoint_commands(erring, wanted, POINTS, limits=limits).checks
    fine, aside, near, far, elsewhere = checks.reasons()
    assert fine == ""
    assert "of the target is well inside" in aside
    assert "too near to be sharp" in near
    assert "0.109 m" in near
    assert "too far to be sharp" in far
    assert "only 0%" in elsewhere
    assert "as far out as the poses" in elsewhere
    np.testing.assert_array_equal(checks.ok, [True, False, False, False, False])
    # Part of the target may be enough.
    some = viewpoint_commands(
        erring, wanted, POINTS, limits=dataclasses.replace(limits, min_visible_fraction=0.3)
    ).checks
    assert bool(some.passed["in_picture"][1])


def test_a_single_view_has_single_checks(erring):
    wanted = look_at(CENTRE, DOWN, 0.05)
    commands = viewpoint_commands(erring, wanted, POINTS)
    off = (commands.predicted_views.camera_from_world @ wanted.inverse()).log()
    assert float(jnp.abs(off).max()) < 1e-12
    checks = commands.checks
    assert checks.ok.shape == ()
    assert len(checks.reasons()) == 1
    assert "inside the picture" in checks.reasons()[0]


def test_camera_and_tool_stay_above_the_table():
    calibration = paper_calibration()
    wanted = look_at(np.zeros(3), DOWN, np.array([0.2, 0.1]))
    camera = (calibration.base_from_world @ wanted.inverse()).translation()
    poses = calibration.command_for(wanted)
    heights = 0.5 * (np.asarray(poses.translation())[:, 2] + np.asarray(camera)[:, 2])
    # A table half way between the camera and the tool of the lower view, and no clearance.
    table = ClearancePlane(point=[0.0, 0.0, heights[1]], camera_clearance=0.0, tool_clearance=0.0)
    checks = viewpoint_commands(calibration, wanted, limits=Limits(clearance_plane=table)).checks
    np.testing.assert_allclose(
        checks.measured["camera_clearance"], np.asarray(camera)[:, 2] - heights[1], atol=1e-12
    )
    above, below = checks.reasons()
    assert above == ""
    assert ("camera" in below) == (float(camera[1, 2]) < heights[1])
    assert ("tool" in below) == (float(poses.translation()[1, 2]) < heights[1])
    assert below.count("above the table: too low") == 1


def test_an_arms_joints_are_found_and_what_it_cannot_reach_is_said(arm_setting):
    calibration, arm, joints = arm_setting
    wanted = look_at(CENTRE, DOWN, np.array([0.2, 3.0]))
    commands = viewpoint_commands(calibration, wanted, POINTS, arm, joints)
    np.testing.assert_allclose(
        arm.base_from_tool(commands.joints[0]).as_matrix(),
        SE3(commands.base_from_tool.wxyz_xyz[0]).as_matrix(),
        atol=1e-8,
    )
    assert commands.checks.reasons() == ("", "out of reach")
    with pytest.raises(ValueError, match="give near=joints"):
        viewpoint_commands(calibration, wanted, POINTS, arm)


def test_limits_and_singularities_are_told_from_what_is_out_of_reach(arm_setting):
    calibration, arm, joints = arm_setting
    command = arm.base_from_tool(np.array([joints, joints]))
    straight = arm.base_from_tool(np.asarray(joints) * [1.0, 1.0, 1.0, 1.0, 0.0, 1.0])
    poses = SE3(command.wxyz_xyz.at[1].set(straight.wxyz_xyz))
    wanted = calibration.camera_from_world(poses)
    free = viewpoint_commands(calibration, wanted, arm=arm, near=joints).checks
    assert free.reasons() == ("", "singular wrist: joints 4 and 6 turn about one axis")
    assert not bool(free.ok[1])
    narrow = arm.limits.at[0].set(jnp.array([1.0, 1.1]))
    held = dataclasses.replace(arm, limits=narrow)
    checks = viewpoint_commands(calibration, wanted, arm=held, near=joints).checks
    assert checks.reasons()[0] == "out of limits: joint 1"
    assert not checks.passed["reach"].any()


def test_an_arms_own_errors_are_made_up_for(arm_setting):
    calibration, arm, joints = arm_setting
    offsets = RobotError(JointOffsets(arm), jnp.array([0.0, 2e-3, -1e-3, 1e-3, 0.0, 0.0]))
    erring = dataclasses.replace(calibration, robot_error=offsets)
    wanted = look_at(CENTRE, DOWN, np.array([0.2, 3.0]))
    commands = viewpoint_commands(erring, wanted, POINTS, near=joints)
    reached = erring.camera_from_world(commands.command).wxyz_xyz[0]
    off = (SE3(reached) @ SE3(wanted.wxyz_xyz[0]).inverse()).log()
    assert float(jnp.abs(off).max()) < 1e-8
    assert commands.checks.reasons() == ("", "the arm does not get there")
    with pytest.raises(ValueError, match="give near=joints"):
        viewpoint_commands(erring, wanted, POINTS)


def test_a_camera_next_to_the_arm():
    """The target moves instead; the same picture comes about."""
    base = paper_calibration()
    fixed = Calibration.eye_to_hand(base.camera, base.base_from_world.inverse(), SE3.identity())
    commands = viewpoint_commands(
        fixed, FIVE, POINTS, limits=Limits(clearance_plane=ClearancePlane())
    )
    off = (commands.predicted_views.camera_from_world @ FIVE.inverse()).log()
    assert float(jnp.abs(off).max()) < 1e-12
    camera = commands.checks.measured["camera_clearance"]
    np.testing.assert_allclose(camera, base.base_from_world.translation()[2], atol=1e-12)
