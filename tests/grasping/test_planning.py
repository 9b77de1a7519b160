"""Whole grasps: their commands by Eq. 20, what refuses them, and how they are ranked."""

import csv
import dataclasses
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from solids import box

import smartview_jax as sv
from smartview_jax.geometry import host_matrices, host_transforms
from smartview_jax.grasping import (
    PHASES,
    GraspPlan,
    GraspScene,
    Motion,
    NoSafeGraspError,
    Obstacle,
    PlacedObject,
    grasps_for,
)
from smartview_jax.grasping.collisions import CollisionChecker, arm_links
from smartview_jax.grasping.motions import _joint_reasons
from smartview_jax.io import read_viewpoints
from smartview_jax.modeling import find_symmetry, grasp_on_face
from smartview_jax.robot_errors import DHErrors, RobotError
from smartview_jax.robots import Gripper, six_axes
from smartview_jax.simulation import random_truth
from smartview_jax.simulation.arm_scenes import HOME_JOINTS

for needed in ("fcl", "mapbox_earcut", "trimesh"):
    pytest.importorskip(needed)

BOX = box(0.06, 0.04, 0.03, name="box")
TOP = grasp_on_face(BOX, 1, opening_direction=np.array([0.0, 1.0, 0.0]), depth=0.02)
MODEL = dataclasses.replace(BOX, grasps=(TOP,))
GRIPPER = Gripper()
SMALL = np.diag([2e-4] * 3 + [2e-3] * 3) ** 2

CALIBRATION = random_truth(0, error_scale=0.0).calibration.uncorrected


def placed(covariance=SMALL, model=MODEL, x=0.1, y=-0.1, turn=0.3):
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    pose[:2, 3] = x, y
    return PlacedObject(model, pose, covariance)


@pytest.fixture(scope="module")
def scene():
    return GraspScene(
        CALIBRATION, (Obstacle.table(),), arm=six_axes(), near=HOME_JOINTS, link_radius=0.04
    )


@pytest.fixture(scope="module")
def plan(scene):
    return grasps_for(placed(), GRIPPER, scene)


def test_the_tool_is_where_eq_20_puts_it(plan):
    best = plan.best
    # base_from_tool = base_from_world @ world_from_object @ object_from_tool, and the gripper is
    # 0.11 m in front of the tool.
    expected = (
        host_matrices(CALIBRATION.base_from_world)
        @ placed().world_from_object
        @ TOP.object_from_tool
        @ np.linalg.inv(GRIPPER.tool_from_gripper)
    )
    half_turn = expected @ np.diag([-1.0, -1.0, 1.0, 1.0])
    actual = best.base_from_tool[PHASES.index("grasp")]
    assert np.allclose(actual, expected) or np.allclose(actual, half_turn)


def test_before_it_the_approach_and_after_it_straight_up(plan):
    pre, grasp, lift, retreat = plan.best.world_from_gripper
    assert np.allclose(pre[:3, 3], grasp[:3, 3] - 0.06 * grasp[:3, 2])
    assert np.allclose(lift[:3, 3] - grasp[:3, 3], [0.0, 0.0, 0.03])
    assert np.allclose(retreat[:3, 3] - grasp[:3, 3], [0.0, 0.0, 0.15])


def test_the_joints_reach_the_poses(plan):
    best = plan.best
    reached = host_matrices(six_axes().base_from_tool(best.joints))
    assert np.allclose(reached, best.base_from_tool, atol=1e-8)


def test_a_fitted_error_of_the_arm_is_compensated(scene):
    truth = random_truth(3).calibration
    best = grasps_for(placed(), GRIPPER, dataclasses.replace(scene, calibration=truth)).best
    # The true arm, sent to the joints, has the gripper at the object.
    actual_pose = eqx.filter_jit(lambda error, command: error.actual_pose(command))
    actual = host_matrices(actual_pose(truth.robot_error, six_axes().command(best.joints)))
    gripper = np.linalg.inv(host_matrices(truth.base_from_world)) @ actual
    assert np.allclose(gripper @ GRIPPER.tool_from_gripper, best.world_from_gripper, atol=1e-7)
    assert not np.allclose(host_matrices(six_axes().base_from_tool(best.joints)), actual, atol=1e-4)


def test_a_grasp_is_written_for_robots_as_viewpoints_are(plan, tmp_path):
    best = plan.best
    for name in ("grasp.csv", "grasp.json"):
        best.write(tmp_path / name)
        read = read_viewpoints(tmp_path / name)
        assert read.names == PHASES
        assert np.allclose(host_matrices(read.base_from_tool), best.base_from_tool)
        assert np.allclose(read.joints, best.joints)
    units = json.loads((tmp_path / "grasp.json").read_text())["units"]
    assert units["length"] == "mm"
    # And Eq. 18's numbers, in m and rad.
    again = host_matrices(jax.jit(sv.se3_from_xyzoat)(jnp.asarray(best.xyzoat)))
    assert np.allclose(again, best.base_from_tool)


def test_what_is_written_opens_and_closes_the_gripper(plan, tmp_path):
    best = plan.best
    best.write(tmp_path / "grasp.val")
    lines = (tmp_path / "grasp.val").read_text().splitlines()
    # Open, go there, and from then on as straight as the way was checked.
    assert [line for line in lines if not line.startswith("SET")] == [
        f"OPENI {1e3 * best.opening:.2f}",
        "MOVE pre_grasp",
        "BREAK",
        "MOVES grasp",
        "CLOSEI",
        "MOVES lift",
        "MOVES retreat",
    ]
    best.write(tmp_path / "grasp.csv")
    rows = list(csv.DictReader((tmp_path / "grasp.csv").read_text().splitlines()))
    best.write(tmp_path / "grasp.json")
    entries = json.loads((tmp_path / "grasp.json").read_text())["viewpoints"]
    for phases in (rows, entries):
        assert [phase["motion"] for phase in phases] == ["free", "straight", "straight", "straight"]
        openings = [float(phase["opening_m"]) for phase in phases]
        assert openings == [best.opening, best.opening, 0.0, 0.0]


def test_the_probability_falls_with_the_covariance(scene):
    chances = [
        grasps_for(
            placed(scale**2 * SMALL), GRIPPER, scene, Motion(min_probability=0.0)
        ).best.success_probability
        for scale in (1.0, 20.0, 60.0)
    ]
    assert chances[0] > 0.99
    assert chances[0] > chances[1] > chances[2]


def test_an_object_that_is_too_uncertain_is_not_grasped(scene):
    plan = grasps_for(placed(200.0**2 * SMALL), GRIPPER, scene)
    with pytest.raises(NoSafeGraspError, match=r"no safe grasp of box.*less than 50% chance"):
        _ = plan.best


def test_what_stands_in_the_way_is_named(scene):
    wall = np.eye(4)
    wall[:3, 3] = [0.1, -0.1, 0.2]
    covered = scene.with_obstacles([Obstacle.box("lid", (0.3, 0.3, 0.01), wall)])
    plan = grasps_for(placed(), GRIPPER, covered)
    assert not len(plan)
    assert "touches lid" in plan.summary
    # And another object next to it, which the open fingers would hit.
    neighbour = placed(x=0.1 - 0.045 * np.sin(0.3), y=-0.1 + 0.045 * np.cos(0.3))
    crowded = grasps_for(placed(), GRIPPER, scene.with_objects([neighbour]))
    assert all("box" in "; ".join(grasp.reasons) for grasp in crowded.refused)


def test_out_of_reach_is_said_with_the_phases(scene):
    plan = grasps_for(placed(x=3.0), GRIPPER, dataclasses.replace(scene, obstacles=()))
    assert not len(plan)
    assert "out of reach (pre_grasp)" in plan.summary


def test_the_reason_that_decided_comes_first(plan):
    """Of many grasps against walls, and one that only the covariance stopped."""
    best, nothing = plan.best, np.full((4, 4, 4), np.nan)
    against = [
        dataclasses.replace(
            best,
            reasons=(f"the palm touches wall {k}",),
            base_from_tool=nothing,
            success_probability=float("nan"),
        )
        for k in range(8)
        for _ in range(10 - k)
    ]
    late = dataclasses.replace(
        against[0], reasons=("out of reach",), base_from_tool=np.ones((4, 4, 4))
    )
    last = dataclasses.replace(best, reasons=("less than 50% chance",), success_probability=0.2)
    for refused in ([*against, late, last], [last, late, *against]):
        summary = GraspPlan((), tuple(refused), "box").summary
        first, second, third = summary.split("; ")[1:4]
        assert first == "1 of them: less than 50% chance"
        assert second == "1 of them: out of reach"
        assert third == "10 of them: the palm touches wall 0"
        assert summary.endswith("7 of them: the palm touches wall 3; and 4 other reasons")


def test_a_large_covariance_is_named_among_collisions(scene):
    """The table refuses most grasps from all sides; two are stopped by the covariance."""
    plan = grasps_for(placed(200.0**2 * SMALL, BOX), GRIPPER, scene)
    assert not len(plan)
    assert "less than 50% chance" in plan.summary.split("; ")[1]
    far = grasps_for(placed(x=3.0), GRIPPER, dataclasses.replace(scene, obstacles=()))
    assert {grasp.checks_passed for grasp in far.refused} == {1}


def test_a_singular_wrist_is_refused(scene):
    joints = np.array(HOME_JOINTS, dtype=float)
    # Joints 4 and 6 turn about one axis where joint 5 is straight.
    joints[4] = 0.0
    base_from_tool = host_matrices(six_axes().base_from_tool(joints))
    world_from_gripper = (
        np.linalg.inv(host_matrices(CALIBRATION.base_from_world))
        @ base_from_tool
        @ GRIPPER.tool_from_gripper
    )
    pose = world_from_gripper @ np.linalg.inv(TOP.object_from_tool)
    inclined = PlacedObject(MODEL, pose, SMALL)
    free = dataclasses.replace(scene, obstacles=(), near=joints)
    plan = grasps_for(inclined, GRIPPER, free)
    assert not len(plan)
    assert all("singular wrist" in grasp.reasons[0] for grasp in plan.refused)
    assert all("grasp" in grasp.reasons[0] for grasp in plan.refused)


def test_joint_limits_are_kept(scene):
    narrow = np.tile([-np.pi, np.pi], (6, 1))
    # The last joint as on a robot that turns its hand by 5 degrees only.
    narrow[5] = np.deg2rad([-5.0, 5.0])
    arm = dataclasses.replace(six_axes(), limits=jnp.asarray(narrow))
    plan = grasps_for(placed(turn=0.8), GRIPPER, dataclasses.replace(scene, arm=arm))
    assert not len(plan)
    assert "out of limits: joint 6" in plan.summary


def test_the_links_of_the_arm_are_kept_clear(scene):
    tower = np.eye(4)
    tower[:3, 3] = [-0.15, -0.1, 0.5]
    blocked = scene.with_obstacles([Obstacle.box("tower", (0.05, 0.5, 1.0), tower)])
    plan = grasps_for(placed(), GRIPPER, blocked)
    assert not len(plan)
    assert "arm's link" in plan.summary
    assert "tower" in plan.summary
    assert len(grasps_for(placed(), GRIPPER, dataclasses.replace(blocked, link_radius=None)))


def test_links_are_kept_clear_between_the_poses_too(scene, plan):
    """A ball bearing in the air that a link passes between the lift and the retreat."""
    joints = plan.best.joints[PHASES.index("lift") :]
    origins = np.asarray(six_axes().frame_origins(np.stack([joints[0], joints.mean(0), joints[1]])))
    world_from_base = np.linalg.inv(host_matrices(CALIBRATION.base_from_world))
    ends = origins @ world_from_base[:3, :3].T + world_from_base[:3, 3]
    thin = dataclasses.replace(scene, obstacles=(), link_radius=0.01)

    def bearing(spot):
        pose = np.eye(4)
        pose[:3, 3] = spot
        return thin.with_obstacles([Obstacle.box("bearing", (5e-3,) * 3, pose)])

    def gap(spot):
        checker = CollisionChecker(bearing(spot).obstacles)
        contacts = [checker.nearest(arm_links(link_ends[1:], 0.01)) for link_ends in ends[::2]]
        return min(contact.clearance for contact in contacts)

    # Of the links' middles, half on the way, the one that is farthest from both ends.
    spot = max(0.5 * (ends[1, 1:-1] + ends[1, 2:]), key=gap)
    assert gap(spot) > 0.01
    blocked = bearing(spot)
    checker = CollisionChecker(blocked.obstacles)
    reasons = _joint_reasons(blocked, plan.best.joints, checker)
    assert [("touches bearing" in reason, "lift to retreat" in reason) for reason in reasons] == [
        (True,) * 2
    ]
    assert _joint_reasons(thin, plan.best.joints, CollisionChecker(())) == []


def test_a_long_bar_under_a_shelf_is_not_lifted(scene):
    """Far from the fingers: the gripper passes, what it holds does not."""
    bar = box(0.3, 0.02, 0.02, name="bar")
    grasp = grasp_on_face(bar, 1, opening_direction=np.array([0.0, 1.0, 0.0]), depth=0.01)
    localized = placed(model=dataclasses.replace(bar, grasps=(grasp,)), turn=0.0)
    assert len(grasps_for(localized, GRIPPER, scene))
    shelf = np.eye(4)
    # 5 mm above the last 20 mm of the bar, whose frame is at a corner.
    shelf[:3, 3] = [0.1 + 0.29, -0.1 + 0.01, 0.02 + 5e-3 + 1e-3]
    covered = scene.with_obstacles([Obstacle.box("shelf", (0.02, 0.1, 2e-3), shelf)])
    plan = grasps_for(localized, GRIPPER, covered)
    assert not len(plan)
    assert "the held object touches shelf" in plan.summary
    # The gripper alone would pass.
    assert all(one.reasons == ("the held object touches shelf",) for one in plan.refused)


def test_symmetry_finds_a_grasp_where_one_side_is_blocked(scene):
    side = grasp_on_face(BOX, 2, opening_direction=np.array([1.0, 0.0, 0.0]), depth=0.02)
    model = dataclasses.replace(BOX, grasps=(side,))
    # Face 2, the front, lies on the table: only its opposite is free.
    pose = np.eye(4)
    pose[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
    pose[:3, 3] = 0.1, -0.1, 0.0
    lying = PlacedObject(model, pose, SMALL)
    assert not len(grasps_for(lying, GRIPPER, scene))
    symmetric = dataclasses.replace(model, symmetry=find_symmetry(BOX))
    plan = grasps_for(lying._replace(model=symmetric), GRIPPER, scene)
    assert plan.best.world_from_gripper[1, 2, 2] < -0.99


def test_without_an_arm_there_are_poses_but_no_joints():
    plan = grasps_for(placed(), GRIPPER, GraspScene(CALIBRATION, (Obstacle.table(),)))
    assert plan.best.joints is None
    assert np.isfinite(plan.best.base_from_tool).all()


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"world_from_object": 2.0 * np.eye(4)}, "object box"),
        ({"covariance": np.full((6, 6), np.nan)}, "object box: covariance"),
        ({"covariance": -np.eye(6)}, "without negative eigenvalues"),
    ],
)
def test_wrong_poses_and_covariances_are_named(wrong, named):
    with pytest.raises(ValueError, match=named):
        grasps_for(placed()._replace(**wrong), GRIPPER, GraspScene(CALIBRATION))


def test_a_camera_next_to_the_arm_is_refused():
    fixed = sv.Calibration.eye_to_hand(
        CALIBRATION.camera, host_transforms(np.eye(4)), host_transforms(np.eye(4))
    )
    with pytest.raises(
        ValueError, match="eye_to_hand calibration has its world on the tool, where the target is"
    ):
        GraspScene(fixed)


TRIANGLE = np.array([[0, 1, 2]])


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"margin": float("nan")}, "margin: expected metres"),
        ({"margin": -0.01}, "margin: expected metres, from 0"),
        ({"margin": 2.0}, "margin: expected metres, from 0 to 0.5; found 2.0"),
        ({"link_radius": 40.0, "arm": six_axes(), "near": HOME_JOINTS}, "link_radius: expected"),
        ({"up": (0.0, 0.0, float("inf"))}, "up: expected a direction"),
        ({"obstacles": (Obstacle.table(z=500.0),)}, "obstacle table: vertices: expected metres"),
        ({"obstacles": (Obstacle("fog", np.full((3, 3), np.nan), TRIANGLE),)}, "obstacle fog: v"),
        ({"obstacles": (Obstacle("bin", np.eye(3)[:2], TRIANGLE),)}, "indices of 2 vertices"),
        ({"obstacles": (Obstacle("bin", np.zeros((0, 3)), TRIANGLE[:0]),)}, "it has no triangles"),
    ],
)
def test_what_would_hide_a_collision_is_refused(wrong, named):
    """A margin that is not a number is smaller than no distance, so that all grasps were safe."""
    with pytest.raises(ValueError, match=named):
        GraspScene(CALIBRATION, **wrong)


@pytest.mark.parametrize(
    ("size", "pose", "named"),
    [
        ((0.1, -0.1, 0.1), np.eye(4), "obstacle wall: size: expected three positive lengths"),
        ((0.1, 0.1), np.eye(4), "obstacle wall: size: expected three positive lengths"),
        ((0.1, 0.1, 0.1), 2.0 * np.eye(4), "obstacle wall: world_from_box: the last row"),
    ],
)
def test_wrong_boxes_are_refused(size, pose, named):
    with pytest.raises(ValueError, match=named):
        Obstacle.box("wall", size, pose)


def test_wrong_motions_are_refused():
    with pytest.raises(ValueError, match="lift <= retreat"):
        Motion(lift=0.2, retreat=0.1)


def test_robot_error_field_of_an_arm_has_joints_without_naming_the_arm():
    """The errors of an arm are inverted by its own kinematics: near is needed, the arm is not."""
    error = RobotError.zero(DHErrors(six_axes()))
    calibration = dataclasses.replace(CALIBRATION, robot_error=error)
    with pytest.raises(ValueError, match="near"):
        grasps_for(placed(), GRIPPER, GraspScene(calibration))
