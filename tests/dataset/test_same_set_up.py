"""A calibration of another camera or mount is refused, with what may have changed its pictures."""

import dataclasses

import numpy as np
import pytest
from fit_scenes import scene_of

from smartview_jax import Noise, Rig, build_problem, cramer_rao, evaluation, fit_rig
from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.dataset import require_picture_size
from smartview_jax.engine import Observability
from smartview_jax.joint import SavedEstimate


@pytest.mark.parametrize(
    ("size", "words"),
    [
        ((640, 480), "binned by 2 or scaled by 0.5"),
        ((427, 320), "scaled by 0.334"),
        ((1600, 1200), "were they scaled by 1.25"),
        ((960, 1280), "turned by 90 degrees"),
        ((1280, 800), "cut out"),
    ],
)
def test_pictures_of_another_size_are_refused(size, words):
    camera = Camera(900.0, 900.0, 640.0, 480.0, lens=Pinhole(), image_size=(1280, 960))
    require_picture_size("the camera", camera, (1280, 960))
    with pytest.raises(ValueError, match="1280 x 960") as refused:
        require_picture_size("the camera", camera, size)
    assert words in str(refused.value)
    assert ("binned" in str(refused.value)) == (size[0] < 640 or "binned" in words)


ALL_KNOWN = Observability(2, 2, (), (), 1.0)


def estimate_of(calibration):
    """The calibration with a covariance of two of its numbers."""
    names = ("camera.u0", "camera.v0")
    return SavedEstimate(calibration, np.eye(2), names, Noise(0.1, 1e-4, 1e-3), 0.1, ALL_KNOWN)


TAKE_BOTH = {
    "build_problem": lambda calibration, data: build_problem(data, calibration),
    "fit_rig": lambda calibration, data: fit_rig(Rig({"left": data}), {"left": calibration}),
    "cramer_rao": lambda calibration, data: cramer_rao(calibration, data, Noise(0.1, 1e-4, 1e-3)),
    "errors": evaluation.reprojection_errors,
    "expected": lambda calibration, data: evaluation.expected_reprojection_errors(
        estimate_of(calibration), data
    ),
    "free_poses": evaluation.free_pose_errors,
    "picture": lambda calibration, data: evaluation.picture_uncertainty(
        estimate_of(calibration), data
    ),
    "workspace": lambda calibration, data: evaluation.workspace_uncertainty(
        estimate_of(calibration), data
    ),
}
"""What takes a calibration and data."""


@pytest.mark.parametrize("name", TAKE_BOTH)
def test_a_calibration_of_another_set_up_is_refused(name):
    """Half of the pixels, or a camera next to the arm, would pass for a bad robot."""
    scene = scene_of(0)
    halved = dataclasses.replace(scene.data, pixels=scene.data.pixels / 2.0, image_size=(320, 240))
    with pytest.raises(ValueError, match="640 x 480 px, but the data have pictures of 320 x 240"):
        TAKE_BOTH[name](scene.calibration, halved)
    beside = dataclasses.replace(scene.data, mount="eye_to_hand")
    with pytest.raises(ValueError, match="is eye_in_hand, but the data are eye_to_hand"):
        TAKE_BOTH[name](scene.calibration, beside)
