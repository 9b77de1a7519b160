import jax.numpy as jnp
import numpy as np
import pytest

from smartview_jax.geometry import host_exponentials, host_matrices, se3_from_xyzoat
from smartview_jax.robots import Command, arm_by_name
from smartview_jax.simulation import Cell, CellError, DriverCell
from smartview_jax.simulation.arm_scenes import HOME_JOINTS


class Controller:
    """A controller with millimetres, degrees and a gripper in millimetres."""

    def __init__(self):
        self.pose, self.width = [0.0] * 6, 0.0
        self.picture = np.full((4, 6, 3), 100, np.uint8)
        self.stuck = False

    def move(self, pose):
        if not self.stuck:
            self.pose = pose

    def grip(self, width):
        # An object of 25 mm is in the way.
        self.width = max(width, 25.0)


@pytest.fixture
def controller():
    return Controller()


def driver(controller, **more):
    return DriverCell(
        send_pose=controller.move,
        read_pose=lambda: controller.pose,
        grab=lambda: controller.picture,
        send_width=controller.grip,
        read_width=lambda: controller.width,
        **more,
    )


@pytest.fixture
def cell(controller):
    return driver(controller)


def test_the_driver_cell_is_a_cell(cell):
    assert isinstance(cell, Cell)


def test_poses_are_converted_both_ways(cell, controller):
    pose = host_matrices(arm_by_name("six_axes").base_from_tool(HOME_JOINTS))
    reached = cell.move(pose)
    assert np.allclose(host_matrices(reached.base_from_tool), pose)
    # VAL's form in mm and degrees, as the package's own codec of Eq. 18 reads it.
    row = np.array(controller.pose)
    row = np.concatenate([1e-3 * row[:3], np.deg2rad(row[3:])])
    assert np.allclose(host_matrices(se3_from_xyzoat(jnp.asarray(row))), pose)


def test_widths_are_converted_and_an_object_stops_the_fingers(cell, controller):
    assert np.isclose(cell.set_gripper(0.06), 0.06)
    assert np.isclose(controller.width, 60.0)
    assert np.isclose(cell.set_gripper(0.0), 0.025)


def test_pictures_become_grey(cell, controller):
    assert cell.picture().shape == (4, 6)
    controller.picture = None
    with pytest.raises(CellError, match="no picture"):
        cell.picture()
    controller.picture = np.zeros((4, 6))
    with pytest.raises(CellError, match="float64; expected 8 bits"):
        cell.picture()


def test_a_robot_that_did_not_arrive_is_an_error(cell, controller):
    controller.stuck = True
    pose = np.eye(4)
    pose[2, 3] = 0.5
    with pytest.raises(CellError, match="500 mm from the commanded one"):
        cell.move(pose)


def test_a_robot_that_arrived_turned_is_an_error(controller):
    def turned(pose):
        controller.pose = [*pose[:5], pose[5] + controller.turn]

    cell = driver(controller)
    cell._send_pose = turned
    pose = host_matrices(arm_by_name("six_axes").base_from_tool(HOME_JOINTS))
    controller.turn = 0.4
    cell.move(pose)
    controller.turn = 0.6
    with pytest.raises(CellError, match=r"orientation 0\.6 degrees from the commanded one"):
        cell.move(pose)


def test_a_command_moves_by_its_joints_where_these_are_taken_else_by_its_pose(controller):
    command = arm_by_name("six_axes").command(np.array(HOME_JOINTS))
    # As every grasp that was planned with an arm is commanded.
    reached = driver(controller).move(command)
    assert np.allclose(host_matrices(reached.base_from_tool), host_matrices(command.base_from_tool))
    sent = []
    controller.pose = [0.0] * 6
    driver(controller, send_joints=sent.append).move(command)
    assert np.allclose(sent, [HOME_JOINTS])
    assert controller.pose == [0.0] * 6
    # Without joint readings there is nothing else to send.
    driver(controller, send_joints=sent.append).move(Command(command.base_from_tool))
    assert len(sent) == 1
    assert controller.pose != [0.0] * 6


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_nothing_that_is_not_finite_is_sent(controller, wrong):
    sent = []
    cell = driver(controller, send_joints=sent.append)
    joints = np.array(HOME_JOINTS)
    joints[2] = wrong
    with pytest.raises(CellError, match="joint readings that are not finite"):
        cell.move(joints)
    pose = host_exponentials(np.array([0.3, 0.1, 0.4, 0.2, 0.1, 0.0]))
    pose[0, 3] = wrong
    with pytest.raises(CellError, match="pose that is not finite"):
        cell.move(pose)
    assert sent == []
    assert controller.pose == [0.0] * 6


@pytest.mark.parametrize("wrong", [-0.001, np.nan, np.inf])
def test_widths_that_no_gripper_has_are_refused(cell, controller, wrong):
    with pytest.raises(ValueError, match=r"width .* m; expected a finite number of metres"):
        cell.set_gripper(wrong)
    assert controller.width == 0.0


def test_joints_need_a_robot_that_takes_them(cell):
    with pytest.raises(CellError, match="takes poses, not joint readings"):
        cell.move(np.zeros(6))


def test_reports_of_another_length_are_an_error(cell, controller):
    controller.pose = [0.0] * 7
    with pytest.raises(CellError, match="7 numbers; val_oat has 6"):
        cell.where()
