import jax.numpy as jnp
import numpy as np
import pytest

from smartview_jax.geometry import host_matrices, se3_from_xyzoat
from smartview_jax.robots import arm_by_name
from smartview_jax.simulation.arm_scenes import HOME_JOINTS
from smartview_jax.simulation.cell import Cell, CellError, DriverCell


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


@pytest.fixture
def cell(controller):
    return DriverCell(
        send_pose=controller.move,
        read_pose=lambda: controller.pose,
        grab=lambda: controller.picture,
        send_width=controller.grip,
        read_width=lambda: controller.width,
    )


def test_it_is_a_cell(cell):
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


def test_joints_need_a_robot_that_takes_them(cell):
    with pytest.raises(CellError, match="takes poses, not joint readings"):
        cell.move(np.zeros(6))


def test_reports_of_another_length_are_an_error(cell, controller):
    controller.pose = [0.0] * 7
    with pytest.raises(CellError, match="7 numbers; val_oat has 6"):
        cell.where()
