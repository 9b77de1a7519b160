"""Starts of the cameras of a rig: from the target that their neighbours placed, or as given."""

import dataclasses

import numpy as np
import pytest
from fit_scenes import POINTS, scene_of, scene_with
from host_poses import transform_errors
from scipy.stats import chi2

from benchmarks.transform_errors import stated_covariance
from smartview_jax import Noise, Prior, Rig, calibrate, fit_staged
from smartview_jax.engine import step_names
from smartview_jax.geometry import host_exponentials, host_matrices, host_transforms
from smartview_jax.rig_pipeline import doubts_told_by_others
from smartview_jax.runtime.array_namespace import to_device
from smartview_jax.runtime.modules import with_fields
from smartview_jax.simulation import paper_calibration

NOISE = Noise(0.15, 1e-4, 2e-4)
"""Noise of the scenes, as stated."""

LEFT = paper_calibration()

RIGHT = dataclasses.replace(
    LEFT,
    camera_from_mount=host_transforms(
        host_exponentials(np.array([0.02, 0.0, 0.0, 0.0, -0.13, 0.02]))
        @ host_matrices(LEFT.camera_from_mount)
    ),
)
"""A second camera on the hand, which looks inwards."""


def rig_with_few_views(seed, count):
    """Eight views of the left camera, and few of the right one, in states of its own."""
    robot: dict = {"translation_noise": NOISE.translation, "rotation_noise": NOISE.rotation}
    few = scene_with(RIGHT, 2 * seed + 1, **robot).data.select(range(count))
    few = dataclasses.replace(few, view_ids=tuple("abcdefgh"[:count]))
    return Rig({"left": scene_of(2 * seed, **robot).data, "right": few})


def squared_error(fit):
    """The squared error of the right camera's place in units of its covariance."""
    found = fit.calibrations["right"].camera_from_mount
    error = transform_errors(found, RIGHT.camera_from_mount)
    return error @ np.linalg.solve(stated_covariance(fit, "right.camera_from_tool"), error)


def test_a_camera_with_few_views_is_known_as_well_as_said():
    squares, messages = [], []
    for seed in range(3):
        fit = calibrate(
            rig_with_few_views(seed, 1 + seed % 2),
            "radial",
            camera={"right": RIGHT.camera},
            noise=NOISE,
            progress=messages.append,
        )
        squares.append(squared_error(fit))
        assert max(fit.std[name] for name in step_names("right.camera_from_tool")[:3]) < 2e-3
        assert float(fit.calibrations["right"].camera.alpha_u) == float(RIGHT.camera.alpha_u)
    assert "right: from the place of its target that left tells" in messages
    assert chi2.ppf(0.01, 18) < sum(squares) < chi2.ppf(0.99, 18)


def test_the_noise_is_estimated_with_five_points_in_a_view_alone():
    """A free lens would pass through them exactly, and leave no noise."""
    rig = rig_with_few_views(1, 1)
    few = np.zeros((1, len(POINTS)), dtype=bool)
    few[0, [0, 3, 6, 7, 13]] = True
    right = rig.cameras["right"].with_visible(few)
    rig = rig.with_cameras({**rig.cameras, "right": right})
    fit = calibrate(rig, "radial", camera={"right": RIGHT.camera}, field=None)
    for sigma in fit.pixel_sigmas.values():
        assert 0.5 * NOISE.pixel < sigma < 2.0 * NOISE.pixel
    assert squared_error(fit) < chi2.ppf(0.999, 6)


def test_what_few_views_need_is_said():
    rig = rig_with_few_views(0, 2)
    with pytest.raises(ValueError, match="'right': 2 usable views do not tell its lens: take 3"):
        calibrate(rig, "radial", noise=NOISE)
    known = {"right": RIGHT.camera}
    apart = Rig(rig.cameras, {"left": "table", "right": "wall"})
    with pytest.raises(ValueError, match="if another camera on the same arm sees its target 'wall"):
        calibrate(apart, "radial", camera=known, noise=NOISE)
    blind = rig.with_cameras({**rig.cameras, "right": rig.cameras["right"].mask_views([0, 1])})
    with pytest.raises(ValueError, match="camera 'right': no view with 4 points"):
        calibrate(blind, "radial", camera=known, noise=NOISE)


def test_a_place_that_is_given_is_held():
    """Of a camera with many views, and of one with few; the target stays where the pictures say."""
    known = {"right": RIGHT.camera}
    moved = host_transforms(
        host_exponentials(np.array([2e-3, 0.0, 0.0, 0.0, 0.0, 0.0]))
        @ host_matrices(RIGHT.camera_from_mount)
    )
    start = {
        "left": {"camera_from_tool": LEFT.camera_from_mount},
        "right": {"camera_from_tool": moved},
    }
    # Priors, and not fixed paths, so that the program of the other tests serves here as well.
    held = {f"{name}.camera_from_tool": Prior(std=1e-9) for name in start}
    fit = calibrate(
        rig_with_few_views(0, 2), "radial", camera=known, start=start, priors=held, noise=NOISE
    )
    for name, given in (("left", LEFT.camera_from_mount), ("right", moved)):
        found = fit.calibrations[name].camera_from_mount
        np.testing.assert_allclose(found.wxyz_xyz, given.wxyz_xyz, atol=1e-8)
    place = fit.calibrations["left"].holder_from_world.translation()
    np.testing.assert_allclose(place, LEFT.holder_from_world.translation(), atol=2e-3)


def test_a_start_that_the_pictures_contradict_is_named_and_not_used():
    rig, known = rig_with_few_views(0, 2), {"right": RIGHT.camera}
    start = {"left": {"camera_from_tool": LEFT.camera_from_mount.inverse()}}
    fit = calibrate(rig, "radial", camera=known, start=start, noise=NOISE)
    (text,) = (text for text in fit.warnings if "start" in text)
    assert text.startswith("left: the start's camera_from_tool does not belong to these data")
    assert text.endswith("the fit does without it")
    without = calibrate(rig, "radial", camera=known, noise=NOISE)
    np.testing.assert_allclose(fit.covariance, without.covariance, rtol=1e-6, atol=1e-18)


def test_starts_of_another_rig_are_refused():
    rig, known = rig_with_few_views(0, 2), {"right": RIGHT.camera}
    other = dataclasses.replace(
        LEFT,
        holder_from_world=host_transforms(np.eye(4)),
        camera_from_mount=RIGHT.camera_from_mount,
    )
    three = Rig({**rig.cameras, "third": rig.cameras["left"]})
    for cameras, start, message in (
        (rig, {"top": LEFT}, "start: expected cameras of left, right, found top"),
        (rig, {"right": {"base_from_world": np.eye(4)}}, "give it for that camera"),
        (rig, {"left": {"camera_from_base": np.eye(4)}}, "camera 'left': start: expected camera_f"),
        (three, {"left": LEFT, "third": other}, "cameras 'left' and 'third' see one target, 'targ"),
    ):
        with pytest.raises(ValueError, match=message):
            calibrate(cameras, "radial", camera=known, start=start, noise=NOISE)
    with pytest.raises(TypeError, match="start: expected starts by camera for a rig, found"):
        calibrate(rig, "radial", camera=known, start=LEFT)


def test_a_doubt_that_another_camera_ends_is_not_told():
    """Three views fit inverted poses as well; eight views of another camera on the hand do not."""
    rig = rig_with_few_views(0, 3)
    staged = {
        name: fit_staged(data, "radial", conventions="report") for name, data in rig.cameras.items()
    }
    doubts = doubts_told_by_others(rig, staged)
    assert doubts["left"] == ()
    (text,) = doubts["right"]
    assert "as well with every pose inverted" in text
    assert text in staged["right"].warnings
    alone = Rig({"right": rig.cameras["right"]})
    assert doubts_told_by_others(alone, {"right": staged["right"]}) == {"right": ()}
    # Turns about one axis tell no direction of the poses, and have no closure error.
    report = staged["left"].conventions._replace(closure_score=0.0)
    staged["left"] = with_fields(staged["left"], conventions=report)
    assert doubts_told_by_others(rig, staged)["right"] == ()


def test_pictures_of_two_cameras_that_were_exchanged_are_named():
    """Each camera alone seems to have been moved."""
    scene = scene_of(0)
    pixels, valid = map(np.array, RIGHT.project(scene.base_from_tool, POINTS))
    pixels += np.random.default_rng(0).normal(0.0, 0.15, pixels.shape)
    seen = np.asarray(scene.data.visible) & valid
    seen &= ((pixels > 0.0) & (pixels < np.array(scene.data.image_size))).all(axis=2)
    left = np.where(seen[..., None], scene.data.pixels, np.nan)
    right = np.where(seen[..., None], pixels, np.nan)
    states = [1, 4, 6]
    left[states], right[states] = right[states], left[states]
    cameras = {
        name: dataclasses.replace(scene.data, pixels=to_device(shown), visible=to_device(seen))
        for name, shown in (("left", left), ("right", right))
    }
    with pytest.raises(ValueError, match=r"are exchanged in 3 of 8 states \(1, 4, 6\)"):
        calibrate(Rig(cameras), lens="radial")
