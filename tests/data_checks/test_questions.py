"""Of two faults in one data set the one that comes first in the chain is named first."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartview_jax import Dataset
from smartview_jax.data_checks.questions import Findings
from smartview_jax.geometry import host_matrices
from smartview_jax.staged import fit_staged


@pytest.fixture(scope="module")
def wrong(scene):
    """A function that makes the data set with some parts changed."""
    data = scene.data

    def make(points=1.0, pixels=lambda pixels: pixels, poses=lambda poses: poses):
        return Dataset.from_arrays(
            points * np.array(data.points),
            pixels(np.array(data.pixels)),
            poses(np.array(host_matrices(data.base_from_tool))),
            data.image_size,
        )

    return make


def in_degrees(poses):
    """Rotation vectors in degrees, taken for radians."""
    vectors = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
    poses[:, :3, :3] = Rotation.from_rotvec(np.rad2deg(vectors)).as_matrix()
    return poses


def renumbered(pixels):
    """The points of view 4 in another order."""
    pixels[4] = pixels[4, np.random.default_rng(0).permutation(pixels.shape[1])]
    return pixels


def test_each_question_is_asked_of_what_the_earlier_ones_left():
    everything = Findings(("poses",), ("detections",), ("camera",), ("motions",))
    assert everything.problems == (
        "poses",
        "detections",
        "camera",
        "as seen with this camera, motions",
    )
    explained = everything._replace(motions_explained=True)
    assert explained.problems == ("poses", "detections", "motions", "camera")
    assert everything._replace(camera=()).problems == ("poses", "detections", "motions")
    assert everything._replace(motions=()).problems == ()


def test_poses_that_were_read_some_rows_earlier_come_before_the_target(wrong):
    """And the target of twice its size is not what makes them wrong."""
    stale = wrong(points=2.0, poses=lambda poses: poses[[0, 1, 2, 3, 4, 1, 6, 3]])
    fit = fit_staged(stale)
    named = {view: text for view, point, text in fit.rejected if point is None}
    assert set(named) == {"5", "7"}
    assert "its pose repeats view 1's although the picture moved" in named["5"]
    assert fit.conventions.problems == ()
    assert fit.conventions.suspicious_views == ()
    assert fit.conventions.length_ratio == pytest.approx(2.0, abs=0.1)


def test_a_row_that_was_copied_from_a_later_one_is_the_wrong_one(wrong):
    fit = fit_staged(wrong(poses=lambda poses: poses[[0, 6, 2, 3, 4, 5, 6, 7]]))
    named = {view: text for view, point, text in fit.rejected if point is None}
    assert set(named) == {"1"}
    assert "its pose repeats view 6's" in named["1"]


def test_detections_come_before_the_unit_of_angles(wrong):
    data = wrong(pixels=renumbered, poses=in_degrees)
    problems = fit_staged(data, conventions="report").conventions.problems
    assert problems[0].startswith("view 4: its points are not the target's")
    assert "(degrees?)" in problems[1]


def test_a_camera_that_does_not_fit_does_not_hide_how_the_poses_are_wrong(wrong, scene):
    """A mistake that explains how robot and camera move is likelier than the camera's effect."""
    inverted = wrong(poses=np.linalg.inv)
    camera = scene.calibration.camera
    wide = dataclasses.replace(camera, alpha_u=0.7 * camera.alpha_u)
    first, second = fit_staged(inverted, camera=wide, conventions="report").conventions.problems
    assert "every pose is inverted" in first
    assert second.startswith("the known camera does not fit these pictures")
    (problem,) = fit_staged(inverted, camera=camera, conventions="report").conventions.problems
    assert "every pose is inverted" in problem


def test_a_camera_that_fits_the_middle_alone_is_doubted(wrong, scene):
    """The points near the border are left out as outliers, and what is left fits."""
    camera = scene.calibration.camera

    def bent(pixels):
        rays = pixels - [float(camera.u0), float(camera.v0)]
        radii = np.linalg.norm(rays, axis=2, keepdims=True)
        far = radii > np.nanquantile(radii, 0.95)
        return np.clip(np.where(far, pixels + 12.0 * rays / radii, pixels), 0.0, [639.0, 479.0])

    (text,) = fit_staged(wrong(pixels=bent), camera=camera).warnings
    assert text.startswith("the known camera does not fit the border of the pictures: of")
