"""Blurred, noisy and badly exposed pictures, and objects that touch: never a wrong pose."""

import dataclasses

import cv2
import numpy as np
import pytest
from drawn_edges import calibration, drawn, evidence, seen_views, together
from placed_box import MIDDLE, MODEL, POSE
from seen_scene import CALIBRATION, errors, seen_scene

from smartview_jax.localization import Hypothesis, localize
from smartview_jax.modeling import find_symmetry

RIGHT = 3.0, 3.0
"""Largest errors of a right pose, degrees and mm."""


def blurred(sigma):
    return lambda picture, rng: cv2.GaussianBlur(picture, (0, 0), sigma)


def noisy(sigma):
    return lambda picture, rng: np.clip(
        picture + sigma * rng.standard_normal(picture.shape), 0.0, 255.0
    ).astype(np.uint8)


def exposed(factor):
    return lambda picture, rng: np.clip(factor * picture.astype(float), 0.0, 255.0).astype(np.uint8)


def poses_of(views):
    """`base_from_tool`, tool and camera being one frame, and so base and world."""
    return np.linalg.inv(views.camera_from_world)


def searched(spoilt):
    """What is found of the scene's models in spoilt pictures."""
    scene, rng = seen_scene(), np.random.default_rng(0)
    pictures = [spoilt(one, rng) for one in scene.pictures]
    return localize(pictures, poses_of(scene.views), CALIBRATION, scene.models)


def is_right(one, truth):
    angle, shift = errors(one.model, one.world_from_object[None], truth)
    return angle[0] < RIGHT[0] and shift[0] < RIGHT[1]


@pytest.mark.parametrize("spoilt", [blurred(1.2), noisy(3.0), exposed(0.6)],
                         ids=["blurred", "noisy", "dark"])  # fmt: skip
def test_in_pictures_of_moderate_quality_the_objects_are_found(spoilt):
    found = searched(spoilt)
    assert {one.model_index for one in found.accepted} == {0, 1}
    assert all(is_right(one, seen_scene().world_from_object[one.model_index]) for one in found)


@pytest.mark.parametrize(
    "spoilt",
    [blurred(4.0), blurred(9.0), noisy(40.0), exposed(0.15), exposed(1.8)],
    ids=["blurred", "very blurred", "noisy", "very dark", "over-exposed"],
)
def test_in_bad_pictures_no_wrong_pose_is_accepted(spoilt):
    found = searched(spoilt)
    for one in found.accepted:
        assert is_right(one, seen_scene().world_from_object[one.model_index])
    # Whatever is not accepted is explained.
    names = {one.model_index for one in found.accepted}
    assert len(names) == 2 or found.messages


@pytest.mark.parametrize(("factor", "words"), [(0.0, "under-exposed"), (20.0, "over-exposed")])
def test_pictures_in_which_nothing_can_be_seen_are_refused(factor, words):
    with pytest.raises(ValueError, match=f"view 0: picture: {words}"):
        searched(exposed(factor))


@pytest.mark.parametrize("gap", [0.0, 5e-4, 2e-3])
def test_two_objects_that_touch_are_two(gap):
    """Where their faces meet edges of both are at one place, which count for the first one only.

    The second has those of its other faces, and no face that is elsewhere.
    """
    model = dataclasses.replace(MODEL, name="box", symmetry=find_symmetry(MODEL))
    second = POSE.copy()
    second[:3, 3] += POSE[:3, :3] @ [0.06 + gap, 0.0, 0.0]
    views, rng = seen_views(MIDDLE), np.random.default_rng(0)
    pictures = together(
        drawn(model, views, POSE, 0.05, rng), drawn(model, views, second, 0.05, rng)
    )
    # Both, and the poses half a box beside them, which share many edges with one or the other.
    starts = [POSE, second]
    starts += [pose @ np.block([[np.eye(3), np.array([[x], [0.0], [0.0]])], [0.0, 0.0, 0.0, 1.0]])
               for pose in (POSE, second) for x in (-0.03, 0.03)]  # fmt: skip
    hypotheses = [Hypothesis(0, pose, 0.0, 0.0) for pose in starts]
    found = localize(evidence(pictures), poses_of(views), calibration(), model,
                     hypotheses=hypotheses)  # fmt: skip
    for one in found:
        shifts = [errors(model, one.world_from_object[None], t)[1][0] for t in (POSE, second)]
        assert min(shifts) < 0.3
    assert len(found.accepted) == 2
