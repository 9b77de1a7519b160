import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from fit_scenes import scene_of

import smartview_jax as sv
from smartview_jax.detection import circle_radii, detect, predicted_bias
from smartview_jax.simulation import look_at_from_above, paper_calibration, render
from smartview_jax.targets import Chessboard, CircleGrid, StackedTarget

RADIUS = 0.004


def biased_scene():
    """Noise-free views, with every centre where a detector would find it."""
    scene = scene_of(3, pixel_noise=0.0)
    radii = jnp.full(scene.data.points.shape[1], RADIUS)
    bias, _ = predicted_bias(scene.calibration, scene.data.observations, radii)
    return scene, dataclasses.replace(scene.data, pixels=scene.data.pixels + bias)


def test_rendered_circles_are_found_where_the_bias_puts_them():
    """OpenCV's centroids on a picture that knows nothing of conics."""
    truth = paper_calibration()
    board = CircleGrid(4, 5, 0.008, radius=0.003)
    middle = board.points.mean(axis=0)
    pose = truth.command_for(look_at_from_above(middle, 0.22, np.deg2rad(180.0 - 40.0), 0.5))
    actual = detect(render(truth, pose, board, noise=0.0), board).pixels
    orders = [actual[order] for order in board.symmetries]
    known = np.asarray(truth.project(pose, board.points)[0])
    actual = min(orders, key=lambda pixels: np.abs(pixels - known).max())
    data = sv.Dataset.from_arrays(
        board.points, actual[None], pose.as_matrix()[None], (640, 480), target=board
    )
    corrected = np.asarray(sv.correct_circle_centres(data, truth).pixels)[0]
    before, after = (np.linalg.norm(p - known, axis=-1) for p in (actual, corrected))
    assert before.min() > 0.15
    assert after.max() < 0.03


def test_fit_correct_and_fit_again_reaches_the_truth():
    scene, data = biased_scene()
    truth = scene.calibration

    def off(calibration):
        step = calibration.camera_from_tool.inverse() @ truth.camera_from_tool
        return float(np.linalg.norm(step.log()))

    first = sv.fit_joint(data, truth, noise="trusted").calibration
    once = sv.correct_circle_centres(data, first, RADIUS)
    second = sv.fit_joint(once, first, noise="trusted").calibration
    assert off(first) > 1e-5
    assert off(second) < 0.01 * off(first)
    seen = np.asarray(data.visible)
    twice = sv.correct_circle_centres(data, second, RADIUS)
    assert np.abs(np.asarray(once.pixels - twice.pixels))[seen].max() < 1e-3


def test_a_target_larger_than_stated_has_larger_circles():
    """Scale and camera distance grow together: the picture, and so the shift, is the same."""
    scene, data = biased_scene()
    truth, radii = scene.calibration, jnp.full(data.points.shape[1], RADIUS)
    grown = sv.Calibration.eye_in_hand(
        truth.camera, truth.camera_from_tool, truth.base_from_world, target_scale=1.1
    )
    shrunk = dataclasses.replace(data.observations, points=data.points / 1.1)
    np.testing.assert_allclose(
        predicted_bias(grown, shrunk, radii / 1.1)[0],
        predicted_bias(truth, data.observations, radii)[0],
        rtol=1e-9,
    )


def test_radii_of_targets():
    marked = CircleGrid(2, 3, 0.01, origin_mark=True, radius=0.002, mark_radius=0.003)
    np.testing.assert_allclose(circle_radii(marked), [0.003] + 5 * [0.002])
    stacked = StackedTarget(marked, (0.0, 0.01))
    np.testing.assert_allclose(circle_radii(stacked), 2 * ([0.003] + 5 * [0.002]))
    for target, message in [
        (Chessboard(3, 4, 0.01), "expected circles"),
        (None, "expected circles"),
        (CircleGrid(2, 3, 0.01), "radius: the target does not state it"),
        (CircleGrid(2, 3, 0.01, origin_mark=True, radius=0.002), "mark_radius: the target"),
    ]:
        with pytest.raises(ValueError, match=message):
            circle_radii(target)


def test_what_is_wrong_is_named():
    scene, data = biased_scene()
    for radius, message in [
        (0.0, "positive"),
        (np.array([0.001, 0.002]), "expected one number or 14"),
        (0.5, "view 0: circle 0 is visible, but"),
    ]:
        with pytest.raises(ValueError, match=message):
            sv.correct_circle_centres(data, scene.calibration, radius)
