import dataclasses

import numpy as np
import pytest

import smartview_jax as sv
from smartview_jax.geometry import host_matrices
from smartview_jax.robots import Command
from smartview_jax.simulation import (
    Bin,
    Cell,
    CellError,
    CellObject,
    SimulatedCell,
    box,
    look_at_from_above,
    random_truth,
    stepped_block,
)

for needed in ("mujoco", "trimesh", "embreex"):
    pytest.importorskip(needed)

BLOCK = CellObject("block", box(0.06, 0.04, 0.03))
STEP = CellObject("step", stepped_block(0.05))


def small_cell(seed, **options):
    """A cell whose camera has pixels four times as large: a sixteenth of the rays."""
    truth = random_truth(seed)
    camera = truth.calibration.camera
    small = sv.Camera(350.0, 349.8, 161.0, 97.6, camera.lens, (320, 200))
    calibration = dataclasses.replace(truth.calibration, camera=small)
    return SimulatedCell(seed, truth=dataclasses.replace(truth, calibration=calibration), **options)


@pytest.fixture(scope="module")
def cell():
    return small_cell(1)


def view(cell, tilt=0.2, azimuth=0.5, distance=0.45):
    """A command for a view of the middle, by the calibration as it is drawn."""
    pose = look_at_from_above(cell.centre, distance, tilt, azimuth)
    return host_matrices(cell.truth.calibration.uncorrected.command_for(pose))


def test_the_simulated_cell_is_a_cell(cell):
    assert isinstance(cell, Cell)


def test_the_arm_goes_where_it_reports_but_for_its_own_errors(cell):
    wanted = view(cell)
    reported = cell.move(wanted)
    assert np.allclose(host_matrices(reported.base_from_tool), wanted, atol=1e-9)
    assert np.allclose(host_matrices(cell.where().base_from_tool), wanted, atol=1e-9)
    actual = cell._base_from_tool
    difference = np.linalg.norm(actual[:3, 3] - wanted[:3, 3])
    # Nobody is told of this: a fraction of a millimetre to a few.
    assert 5e-5 < difference < 5e-3


def test_joints_and_commands_are_the_same_as_their_pose(cell):
    pose = cell.move(view(cell, azimuth=1.0))
    by_joints = cell.move(np.asarray(pose.joints))
    by_command = cell.move(Command(pose.base_from_tool, pose.joints))
    for other in (by_joints, by_command):
        assert np.allclose(other.base_from_tool.wxyz_xyz, pose.base_from_tool.wxyz_xyz)


def test_out_of_reach_says_so(cell):
    far = np.eye(4)
    far[:3, 3] = [3.0, 0.0, 0.5]
    before = cell.where()
    with pytest.raises(CellError, match="out of reach"):
        cell.move(far)
    with pytest.raises(CellError, match="not finite"):
        cell.move(np.full(6, np.nan))
    assert np.array_equal(cell.where().joints, before.joints)


def test_the_board_is_found_in_its_pictures_where_the_truth_puts_it():
    cell = small_cell(2)
    cell.move(view(cell))
    detection = sv.detection.detect(cell.picture(), cell.board.board)
    assert detection.pixels.shape == (63, 2)
    truth = cell.truth.calibration.uncorrected
    expected, _ = truth.project(cell._base_from_tool, cell.board.points)
    error = np.linalg.norm(detection.pixels - np.asarray(expected), axis=1)
    # Circles under perspective have their centres a little off their middle.
    assert np.median(error) < 0.2


def test_a_picture_of_an_object_shows_it_where_the_judge_says():
    cell = small_cell(3, bin=None, clutter=False, noise=0.0)
    corner = np.eye(4)
    corner[:3, 3] = cell.centre
    cell.place([BLOCK], [corner])
    cell.move(view(cell))
    with_object = cell.picture().astype(float)
    cell.place([], [])
    without = cell.picture().astype(float)
    cell.place([BLOCK], [corner])
    truth = cell.truth.calibration.uncorrected
    middle = cell.judge().world_from_object["block"] @ np.array([0.0, 0.0, 0.03, 1.0])
    u, v = np.asarray(truth.project(cell._base_from_tool, middle[None, :3])[0])[0]
    # The middle of the top, and a place next to everything.
    changed = np.abs(with_object - without) > 20.0
    assert changed[int(v) - 5 : int(v) + 6, int(u) - 5 : int(u) + 6].all()
    assert not changed[:12, :12].any()


def test_the_same_seed_gives_the_same_scene_and_picture():
    pictures, poses = [], []
    for _ in range(2):
        cell = small_cell(4)
        cell.drop([BLOCK, STEP], seed=5)
        cell.move(view(cell))
        pictures.append(cell.picture())
        poses.append(cell.judge().world_from_object)
    assert np.array_equal(*pictures)
    assert all(np.array_equal(poses[0][name], poses[1][name]) for name in poses[0])
    cell.drop([BLOCK], seed=6)
    assert not np.allclose(cell.judge().world_from_object["block"], poses[0]["block"])


def test_dropped_objects_lie_in_the_bin(cell):
    cell.drop([BLOCK, STEP, *(CellObject(f"b{k}", box(0.03, 0.03, 0.03)) for k in range(4))])
    for obj, pose in zip(cell._objects, cell.judge().world_from_object.values(), strict=True):
        vertices = obj.solid.moved(pose).vertices
        assert (np.abs(vertices[:, :2] - cell.centre[:2]) < [0.121, 0.091]).all()
        assert vertices[:, 2].min() > -1e-5
    # Walls of the bin are known, its objects are not.
    assert len(cell.fixtures) == 4


def test_an_object_is_held_only_between_the_fingers_and_above_the_bin():
    cell = small_cell(6, bin=Bin((0.12, -0.09), (0.2, 0.16, 0.04)))
    corner = np.eye(4)
    corner[:3, 3] = cell.centre
    cell.place([BLOCK], [corner])
    assert cell.judge().held == ()
    cell.set_gripper(0.07)
    poses = {}
    for name, height in (("above", 0.1), ("at", 0.015), ("inside", 0.04), ("lifted", 0.15)):
        gripper = np.diag([1.0, -1.0, -1.0, 1.0])
        gripper[:3, :3] = [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]
        gripper[:3, 3] = [*cell.centre[:2], height]
        tool = gripper @ np.linalg.inv(cell.gripper.tool_from_gripper)
        truth = cell.truth.calibration
        wanted = host_matrices(truth.camera_from_tool) @ np.linalg.inv(tool)
        poses[name] = truth.joints_for(
            sv.geometry.host_transforms(wanted), near=np.asarray(cell.where().joints)
        )
    for name in ("above", "at"):
        cell.move(poses[name])
    # The joints that the truth asks for put the gripper within its repeatability.
    assert np.allclose(cell.judge().world_from_gripper[:3, 3], gripper_at(cell, 0.015), atol=2e-4)
    assert abs(cell.set_gripper(0.0) - 0.04) < 1e-3
    assert cell.judge().held == ()
    # Off the table, but lower than the walls of 40 mm.
    cell.move(poses["inside"])
    assert cell.judge().held == ()
    cell.move(poses["lifted"])
    assert cell.judge().held == ("block",)
    cell.set_gripper(0.08)
    assert cell.judge().held == ()


def gripper_at(cell, height):
    return [*cell.centre[:2], height]


def test_bad_input_is_named(cell):
    with pytest.raises(ValueError, match=r"objects: .* given more than once"):
        cell.drop([BLOCK, BLOCK])
    with pytest.raises(ValueError, match=r"width 80\.0 m"):
        cell.set_gripper(80.0)
    with pytest.raises(ValueError, match="object block"):
        cell.place([BLOCK], [2.0 * np.eye(4)])


@pytest.mark.parametrize(
    ("objects", "poses", "named"),
    [
        ([STEP, BLOCK], [np.eye(4)], "a pose for each of 2 objects, found 1"),
        ([STEP], [np.eye(4), np.eye(4)], "a pose for each of 1 objects, found 2"),
        ([STEP], [2.0 * np.eye(4)], "object step: "),
        ([STEP, STEP], [np.eye(4), np.eye(4)], "given more than once"),
    ],
)
def test_a_cell_that_refused_objects_is_as_it_was(objects, poses, named):
    cell = small_cell(7)
    corner = np.eye(4)
    corner[:3, 3] = cell.centre
    for before in ((), (BLOCK,)):
        if before:
            cell.place([BLOCK], [corner])
        shown = cell.board_shown
        with pytest.raises(ValueError, match=named):
            cell.place(objects, poses)
        assert cell.board_shown == shown
        assert list(cell.judge().world_from_object) == [obj.name for obj in before]


def test_errors_of_the_arm_can_be_switched_off():
    assert np.all(np.asarray(random_truth(0, 0.0).calibration.robot_error.coefficients) == 0.0)
    assert np.any(np.asarray(random_truth(0).calibration.robot_error.coefficients) != 0.0)
