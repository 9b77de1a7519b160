"""What a robot is told to do for a grasp, in which order, by a cell that only takes notes."""

import dataclasses

import numpy as np
import pytest
from solids import box

from smartview_jax.geometry import host_matrices, host_transforms
from smartview_jax.grasping import PHASES, PlannedGrasp
from smartview_jax.modeling import grasp_on_face
from smartview_jax.picking import execute
from smartview_jax.robots import Command
from smartview_jax.simulation.cell import Cell


class Notes:
    """A cell that notes what it is told; an object of a width is between its fingers."""

    def __init__(self, width):
        self.width, self.told, self.at = width, [], Command(host_transforms(np.eye(4)))

    def move(self, target):
        self.told.append(("move", host_matrices(target.base_from_tool)[2, 3], target.joints))
        self.at = target
        return target

    def picture(self):
        return np.zeros((2, 2), np.uint8)

    def set_gripper(self, width):
        self.told.append(("gripper", width))
        return max(width, self.width)

    def where(self):
        return self.at


@pytest.fixture
def grasp():
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 2, 3] = [0.2, 0.1, 0.13, 0.25]
    return PlannedGrasp(grasp_on_face(box(), 1), poses, poses, None, 0.06, 0.04, 0.99, {}, 0.01)


def test_notes_are_a_cell():
    assert isinstance(Notes(0.0), Cell)


def test_open_approach_close_lift_retreat(grasp):
    cell, reached = Notes(0.04), []
    width, text = execute(cell, grasp, reached.append)
    assert [one[:2] for one in cell.told] == [
        ("gripper", 0.06),
        ("move", 0.2),
        ("move", 0.1),
        ("gripper", 0.0),
        ("move", 0.13),
        ("move", 0.25),
    ]
    assert reached == ["pre_grasp", "grasp", "closed", "lift", "retreat"]
    assert width == 0.04
    assert "40.0 mm apart; the object is 40.0 mm" in text


def test_joints_are_sent_where_they_are_known(grasp):
    cell = Notes(0.04)
    joints = np.arange(24.0).reshape(len(PHASES), 6)
    execute(cell, dataclasses.replace(grasp, joints=joints))
    sent = [one[2] for one in cell.told if one[0] == "move"]
    assert np.array_equal(np.stack([np.asarray(one) for one in sent]), joints)


def test_empty_fingers_are_noticed(grasp):
    assert "they hold nothing" in execute(Notes(0.0), grasp)[1]


def test_a_refused_grasp_moves_nothing(grasp):
    cell = Notes(0.04)
    with pytest.raises(ValueError, match="not executed: the palm touches table"):
        execute(cell, dataclasses.replace(grasp, reasons=("the palm touches table",)))
    assert cell.told == []
