import dataclasses

import numpy as np
import pytest
from solids import box, prism

from smartview_jax.grasping import suggested_grasps
from smartview_jax.grasping.candidates import REVOLUTION_STEPS, candidate_grasps
from smartview_jax.modeling import find_symmetry, grasp_on_face, width_between_fingers
from smartview_jax.robots import Gripper

GRIPPER = Gripper(max_opening=0.05)


def test_suggestions_take_every_pair_of_faces_that_fits_the_gripper():
    # 60 mm is too wide for 50 mm: two pairs remain, each approached from four sides.
    grasps = suggested_grasps(box(0.06, 0.04, 0.03), GRIPPER)
    widths = [
        width_between_fingers(box(0.06, 0.04, 0.03), grasp.object_from_tool) for grasp in grasps
    ]
    assert {round(1e3 * w) for w in widths} == {30, 40}
    approaches = {tuple(grasp.approach.round(6)) for grasp in grasps}
    assert len(approaches) == 6
    # Fingertips stay above the support, and reach down along the object within finger length.
    assert all(0.0 < grasp.depth <= GRIPPER.finger_length for grasp in grasps)


def test_faces_that_may_not_be_touched_are_not():
    model = box(0.06, 0.04, 0.03)
    faces = tuple(
        dataclasses.replace(face, graspable=face.name not in ("front", "back"))
        for face in model.faces
    )
    careful = dataclasses.replace(model, faces=faces)
    assert len(suggested_grasps(careful, GRIPPER)) < len(suggested_grasps(model, GRIPPER))
    # Front and back are at a right angle to y.
    assert all(
        abs(grasp.opening_direction[1]) < 1e-9 for grasp in suggested_grasps(careful, GRIPPER)
    )


def test_a_symmetric_model_repeats_its_grasps():
    model = box(0.06, 0.04, 0.03)
    grasp = grasp_on_face(model, 1, opening_direction=np.array([0.0, 1.0, 0.0]))
    single = dataclasses.replace(model, grasps=(grasp,))
    symmetric = dataclasses.replace(single, symmetry=find_symmetry(model))
    plain, repeated = candidate_grasps(single, GRIPPER), candidate_grasps(symmetric, GRIPPER)
    assert len(repeated) == symmetric.symmetry.order * len(plain) == 4 * len(plain)
    for candidate in repeated:
        # Each is the same grasp to the object: as wide there.
        width = width_between_fingers(model, candidate.object_from_gripper)
        assert np.isclose(width, 0.04)


def test_a_surface_of_revolution_is_grasped_from_all_around():
    model = prism(24, radius=0.02)
    grasp = grasp_on_face(model, 25)
    model = dataclasses.replace(model, grasps=(grasp,), symmetry=find_symmetry(model))
    grasps = candidate_grasps(model, GRIPPER)
    assert model.symmetry.axis is not None
    turns = {tuple(candidate.object_from_gripper[:3, 0].round(6)) for candidate in grasps}
    # Half a turn of the gripper is one of the twelve.
    assert len(turns) == REVOLUTION_STEPS


def test_half_a_turn_mirrors_what_is_along_the_fingers():
    model = box(0.06, 0.04, 0.03)
    # 5 mm from one end: the side is longer on the other.
    grasp = grasp_on_face(
        model, 1, np.array([0.005, 0.02, 0.03]), np.array([0.0, 1.0, 0.0]), opening=0.05
    )
    first, turned = candidate_grasps(dataclasses.replace(model, grasps=(grasp,)), GRIPPER)
    assert first.along_finger != turned.along_finger
    assert np.allclose(first.along_finger, np.negative(turned.along_finger[::-1]))
    assert {round(1e3 * abs(end)) for end in first.along_finger} == {4, 16}


def test_a_model_without_its_bottom_is_grasped_by_what_it_has():
    model = box(0.06, 0.04, 0.03)
    opened = dataclasses.replace(model, faces=model.faces[1:])
    grasps = suggested_grasps(opened, GRIPPER)
    # Across the box still; no longer over its height, nor from below.
    assert {round(1e3 * width_between_fingers(model, g.object_from_tool)) for g in grasps} == {40}
    assert all(grasp.approach[2] < 0.5 for grasp in grasps)


def test_a_model_without_faces_says_what_is_missing():
    model = dataclasses.replace(box(0.06, 0.04, 0.03), faces=(), name="wires")
    with pytest.raises(ValueError, match="'wires' has neither grasps nor faces"):
        candidate_grasps(model, GRIPPER)
