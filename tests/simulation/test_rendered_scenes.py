import numpy as np
from jaxlie import SE3

import smartview_jax as sv
from smartview_jax.simulation import look_at_from_above, rendered_scene
from smartview_jax.targets import CircleGrid, StackedTarget


def test_detected_centres_lie_on_the_truth_once_corrected(small_truth):
    """A plain grid looks the same after half a turn: one view is turned so that it comes so."""
    truth = small_truth
    target = StackedTarget(CircleGrid(3, 4, 0.008, radius=0.003), (0.0, 0.01))
    middle = target.points.mean(axis=0)
    views = look_at_from_above(middle, 0.2, np.deg2rad([5.0, 19.0]), 0.3, np.array([0.0, np.pi]))
    told = []
    scene = rendered_scene(
        truth, truth.command_for(views), target, seed=1, progress=told.append, samples=3
    )
    assert told == ["view 1 of 2", "view 2 of 2"]
    assert scene.data.observation_count == 2 * 24
    known = np.asarray(truth.project(scene.base_from_tool, target.points)[0])
    raw, corrected = (
        np.asarray(data.pixels) - known
        for data in (scene.data, sv.correct_circle_centres(scene.data, truth))
    )
    assert np.sqrt(np.mean(raw[1] ** 2)) > 0.03
    assert np.sqrt(np.mean(corrected**2)) < 0.02


def test_a_board_out_of_the_picture_is_not_seen(small_truth):
    truth = small_truth
    aside = np.array([[0.5, 0.0, 0.0], [0.012, 0.008, 0.0]])
    poses = SE3(np.stack([look_at_from_above(place, 0.2, 0.1, 0.0).wxyz_xyz for place in aside]))
    board = CircleGrid(3, 4, 0.008)
    turn = SE3.exp(np.array([0.0, 0.0, 0.0, np.pi, 0.0, 0.0]))
    scene = rendered_scene(truth, truth.command_for(poses @ turn), board, samples=3)
    assert not np.asarray(scene.data.visible[0]).any()
