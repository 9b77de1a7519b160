"""What becomes of an attempt, in words, by cells and plans that are made up."""

import dataclasses
import sys

import numpy as np
import pytest
from fake_cell import BLANK, CALIBRATION, REGION, STRIPED, FakeCell, localizations, seen
from solids import box

from smartview_jax.grasping import GraspPlan, GraspScene, Obstacle, PlannedGrasp
from smartview_jax.joint import SavedEstimate
from smartview_jax.modeling import ObjectModel, grasp_on_face
from smartview_jax.picking import Look, pick
from smartview_jax.robots import Gripper, puma_560

BOX = box(name="box")
ARM = puma_560()
ESTIMATE = SavedEstimate(CALIBRATION, np.eye(2), ("a", "b"), None, 0.1, None)
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

        def grasps_for(one, gripper, scene, motion):
            run.obstacles[one.model.name] = [each.name for each in scene.obstacles]
            own = [GRASP] if safe is None else safe.get(one.model.name, [])
            return GraspPlan(tuple(own), (), one.model.name)

        def look_for(cell, calibration, models, region, **given):
            assert calibration is scene.calibration
            assert given["arm"] is scene.arm is ARM
            assert given["estimate"] is scene.estimate is ESTIMATE
            assert given["occluders"].shape == (12, 3, 3)
            return Look(localizations(*found), (), None, None, ())

        # The function hides its module of the same name.
        module = sys.modules[pick.__module__]
        monkeypatch.setattr(module, "grasps_for", grasps_for)
        monkeypatch.setattr(module, "look_for", look_for)
        scene = GraspScene(
            CALIBRATION, (Obstacle.table(),), arm=ARM, near=np.zeros(6), estimate=ESTIMATE
        )
        return pick(cell or FakeCell(), [BOX], Gripper(), REGION, scene)

    return run


def test_a_bad_first_picture_is_an_outcome():
    cell, scene = FakeCell(STRIPED, BLANK), GraspScene(CALIBRATION)
    result = pick(cell, [BOX], Gripper(), REGION, scene)
    assert result.outcome.startswith("not found: view 2: picture: blank")
    assert result.look is None
    assert np.isnan(result.width)


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
    beside = [seen(model, one) for model, one in zip(others, decisions, strict=True)]
    attempt([seen(BOX), *beside, seen(WIRE, "open")])
    assert attempt.obstacles["box"] == ["table", "second", "third"]
    assert attempt.obstacles["second"] == ["table", "box", "third"]


def test_the_object_with_the_most_probable_grasp_is_chosen(attempt):
    second = box(name="second")
    result = attempt([seen(BOX), seen(second)], {"box": [GRASP], "second": [BETTER]})
    assert result.target.model is second
    assert result.plan.best is result.grasp is BETTER
    assert "the object is 40.0 mm wide" in result.outcome
    assert result.width == FakeCell().width


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
