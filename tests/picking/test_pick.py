"""What becomes of an attempt, in words, by cells and plans that are made up."""

import sys

import numpy as np
import pytest
from fake_cell import BLANK, CALIBRATION, REGION, STRIPED, FakeCell, localizations, seen
from solids import box

from smartview_jax.grasping import GraspPlan, GraspScene, PlannedGrasp
from smartview_jax.modeling import ObjectModel, grasp_on_face
from smartview_jax.picking import Look, pick
from smartview_jax.robots import Gripper

BOX = box(name="box")
WIRE = ObjectModel(BOX.vertices, BOX.edges, name="wire")
GRASP = PlannedGrasp(
    grasp_on_face(BOX, 1), *[np.tile(np.eye(4), (4, 1, 1))] * 2, None, 0.06, 0.04, 0.9, {}, 0.01
)  # fmt: skip


@pytest.fixture
def attempt(monkeypatch):
    """Pick from what is given as found, by plans with the grasps given for each model's name."""

    def run(found, safe=(GRASP,), cell=None):
        run.obstacles = {}

        def grasps_for(one, gripper, scene, motion):
            run.obstacles[one.model.name] = [each.name for each in scene.obstacles]
            return GraspPlan(tuple(safe), (), one.model.name)

        def look_for(*_, **__):
            return Look(localizations(*found), (), None, None, ())

        # The function hides its module of the same name.
        module = sys.modules[pick.__module__]
        monkeypatch.setattr(module, "grasps_for", grasps_for)
        monkeypatch.setattr(module, "look_for", look_for)
        scene = GraspScene(CALIBRATION)
        return pick(cell or FakeCell(), CALIBRATION, [BOX], Gripper(), REGION, scene)

    return run


def test_a_bad_first_picture_is_an_outcome():
    cell, scene = FakeCell(STRIPED, BLANK), GraspScene(CALIBRATION)
    result = pick(cell, CALIBRATION, [BOX], Gripper(), REGION, scene)
    assert result.outcome.startswith("not found: view 2: picture: blank")
    assert result.look is None
    assert np.isnan(result.width)


def test_an_object_without_faces_does_not_keep_another_from_being_grasped(attempt):
    result = attempt([seen(WIRE), seen(BOX)])
    assert result.target.model is BOX
    assert result.outcome.endswith("not avoided, because their models have no faces: wire")
    assert attempt.obstacles == {"box": []}


def test_an_object_without_faces_is_not_grasped(attempt):
    result = attempt([seen(WIRE)])
    assert result.outcome == "no safe grasp of wire: its model has no faces"
    assert result.target is None
    assert result.plan is None
