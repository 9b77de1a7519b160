"""What becomes of an attempt, in words, by cells and plans that are made up.

And what a robot is told to do for a grasp, in which order, by a cell that only takes notes.
"""

import dataclasses
import sys

import numpy as np
import pytest
from fake_cell import BLANK, CALIBRATION, REGION, STRIPED, FakeCell, localizations, seen
from solids import box

from smartview_jax.geometry import host_matrices, host_transforms
from smartview_jax.grasping import PHASES, GraspPlan, GraspScene, Obstacle, PlannedGrasp
from smartview_jax.modeling import ObjectModel, grasp_on_face
from smartview_jax.picking import Look, execute, pick
from smartview_jax.robots import Command, Gripper, puma_560
from smartview_jax.simulation import Cell

BOX = box(name="box")
WIRE = ObjectModel(BOX.vertices, BOX.edges, name="wire")
GRASP = PlannedGrasp(
    grasp_on_face(BOX, 1), *[np.tile(np.eye(4), (4, 1, 1))] * 2, None, 0.06, 0.04, 0.9, {}, 0.01
)  # fmt: skip

BETTER = dataclasses.replace(GRASP, success_probability=0.95)


@pytest.fixture
def attempt(monkeypatch):
    """Pick from what is given as found, by plans with the grasps given for each model's name."""

    def run(found, safe=None, cell=None):
        run.obstacles = {}

        def grasps_for(obj, gripper, scene, motion):
            run.obstacles[obj.model.name] = [each.name for each in scene.obstacles]
            own = [GRASP] if safe is None else safe.get(obj.model.name, [])
            return GraspPlan(tuple(own), (), obj.model.name)

        def look_for(cell, given, models, region, **_):
            assert given is scene
            return Look(localizations(*found), (), None, None, ())

        # The function hides its module of the same name.
        module = sys.modules[pick.__module__]
        monkeypatch.setattr(module, "grasps_for", grasps_for)
        monkeypatch.setattr(module, "look_for", look_for)
        scene = GraspScene(CALIBRATION, (Obstacle.table(),), arm=puma_560(), near=np.zeros(6))
        return pick(cell or FakeCell(), [BOX], Gripper(), REGION, scene)

    return run


def test_a_bad_first_picture_is_an_outcome():
    cell, scene = FakeCell(STRIPED, BLANK), GraspScene(CALIBRATION)
    result = pick(cell, [BOX], Gripper(), REGION, scene)
    assert result.outcome.startswith("not found: view 2: picture: blank")
    assert result.look is None
    assert np.isnan(result.width)


def test_first_views_that_are_not_reached_are_an_outcome():
    cell = FakeCell()
    cell.unreachable = range(4)
    result = pick(cell, [BOX], Gripper(), REGION, GraspScene(CALIBRATION))
    assert result.outcome.startswith("not found: first: 0 of 4 views are reached")
    assert result.look is None


def test_an_object_without_faces_does_not_keep_another_from_being_grasped(attempt):
    result = attempt([seen(WIRE), seen(BOX)])
    assert result.target.model is BOX
    assert result.outcome.endswith("not avoided, because their models have no faces: wire")
    assert attempt.obstacles == {"box": ["table"]}


def test_an_object_without_faces_is_not_grasped(attempt):
    result = attempt([seen(WIRE)])
    assert result.outcome == "no safe grasp of wire: its model has no faces"
    assert result.target is None
    assert result.plan is None


@pytest.mark.parametrize(
    ("decision", "words"),
    [("open", "box: open: ambiguous"), ("rejected", "box: not found: ambiguous")],
)
def test_what_is_not_accepted_is_not_grasped_and_named_by_its_verdict(attempt, decision, words):
    result = attempt([seen(BOX, decision, "ambiguous")])
    assert result.outcome == words
    assert result.target is None
    assert attempt.obstacles == {}


def test_what_may_be_there_is_an_obstacle(attempt):
    others = [box(name=name) for name in ("second", "third", "fourth")]
    decisions = ("accepted", "open", "rejected")
    undecided = [seen(model, decision) for model, decision in zip(others, decisions, strict=True)]
    attempt([seen(BOX), *undecided, seen(WIRE, "open")])
    assert attempt.obstacles["box"] == ["table", "second", "third"]
    assert attempt.obstacles["second"] == ["table", "box", "third"]


def test_the_object_with_the_most_probable_grasp_is_chosen(attempt):
    second = box(name="second")
    result = attempt([seen(BOX), seen(second)], {"box": [GRASP], "second": [BETTER]})
    assert result.target.model is second
    assert result.plan.best is result.grasp is BETTER
    assert "the object is 40.0 mm wide" in result.outcome
    assert result.width == FakeCell().width


def test_the_next_object_is_tried_and_every_object_says_why(attempt):
    second = box(name="second")
    result = attempt([seen(BOX), seen(second)], {"second": [GRASP]})
    assert result.target.model is second
    assert result.considered == (
        "no safe grasp: the model of box has no place for this gripper",
        "second: 1 of 1 grasps are safe; the best () succeeds with 90.0%",
    )


def test_every_object_without_a_safe_grasp_says_why(attempt):
    result = attempt([seen(BOX), seen(WIRE), seen(box(name="second"))], {})
    assert result.outcome == (
        "no safe grasp: the model of box has no place for this gripper; "
        "no safe grasp of wire: its model has no faces; "
        "no safe grasp: the model of second has no place for this gripper"
    )
    assert result.target is result.grasp is None
    assert result.plan.object_name == "second"


def test_a_grasp_that_is_not_executed_to_the_end_says_so(attempt):
    cell = FakeCell()
    cell.unreachable = (1,)
    result = attempt([seen(BOX)], cell=cell)
    assert result.outcome == "not executed to the end: it does not get there"
    assert result.grasp is GRASP
    assert np.isnan(result.width)


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
    assert [order[:2] for order in cell.told] == [
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
    sent = [order[2] for order in cell.told if order[0] == "move"]
    assert np.array_equal(np.stack([np.asarray(readings) for readings in sent]), joints)


def test_empty_fingers_are_noticed(grasp):
    assert "they hold nothing" in execute(Notes(0.0), grasp)[1]


def test_a_refused_grasp_moves_nothing(grasp):
    cell = Notes(0.04)
    with pytest.raises(ValueError, match="not executed: the palm touches table"):
        execute(cell, dataclasses.replace(grasp, reasons=("the palm touches table",)))
    assert cell.told == []
