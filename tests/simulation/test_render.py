import numpy as np
import pytest
from jaxlie import SE3, SO3

import smartview_jax as sv
from smartview_jax.detection import detect
from smartview_jax.io import load_dataset
from smartview_jax.simulation import (
    look_at_from_above,
    render,
    write_pictures,
)
from smartview_jax.simulation.render import sensor_picture
from smartview_jax.targets import Charuco, Chessboard, CircleGrid, StackedTarget, TagGrid

TARGETS = [
    CircleGrid(6, 7, 0.006),
    CircleGrid(6, 7, 0.006, origin_mark=True),
    CircleGrid(9, 4, 0.004, asymmetric=True, light_on_dark=True),
    Chessboard(6, 7, 0.006),
    Charuco(7, 6, 0.006, 0.0045, "DICT_4X4_50"),
    Charuco(7, 6, 0.006, 0.0045, "DICT_4X4_50", legacy=True),
    TagGrid(1, 2, 0.018, 0.005, first_id=3),
    TagGrid(2, 3, 0.012, 0.004, "DICT_5X5_100"),
]


SAMPLES = 3
"""Rays in a pixel, in each direction: one program renders all pictures."""


def facing(target, tilt=0.2, roll=0.3):
    """`camera_from_world` that sees the front of a target from a corner's direction."""
    centre = target.points.mean(axis=0)
    away = SO3.identity() if target.y_up else SO3.from_x_radians(np.pi)
    turn = SE3.from_rotation(away)
    flipped = np.asarray(turn @ centre)
    return look_at_from_above(flipped, 0.2, tilt, 0.7, roll) @ turn


@pytest.mark.parametrize("target", TARGETS, ids=repr)
def test_a_detector_finds_the_points_where_the_calibration_puts_them(small_truth, target):
    """Pattern, lens and frame conventions at once: everything but the detector is ours."""
    truth = small_truth
    pose = truth.command_for(facing(target))
    detection = detect(render(truth, pose, target, samples=SAMPLES), target)
    assert detection.reason is None
    assert detection.visible.mean() > 0.9
    known = np.asarray(truth.project(pose, target.points)[0])
    gaps = [
        np.abs(detection.pixels - known[order])[detection.visible].max()
        for order in target.symmetries
    ]
    # OpenCV refines the corners of tags and boards less well than it finds circles.
    assert min(gaps) < (0.3 if isinstance(target, TagGrid | Charuco) else 0.12)


def test_from_behind_there_is_nothing_to_see(small_truth):
    truth = small_truth
    target = TagGrid(1, 1, 0.02)
    behind = truth.command_for(look_at_from_above(np.zeros(3), 0.2, np.pi, 0.0))
    assert np.ptp(render(truth, behind, target, noise=0.0, samples=SAMPLES)) == 0


def test_a_board_at_two_heights_from_pictures_to_a_data_set(small_truth, tmp_path):
    """Its grid is plain, so every height of every view may come in either order."""
    truth = small_truth
    target = StackedTarget(CircleGrid(6, 7, 0.005), (0.0, 0.02))
    # A board whose own y points down is turned to y up: its points lie at negative y.
    shift = SE3.from_translation(np.array([0.003, 0.0275, 0.0]))
    roll = np.random.default_rng(1).uniform(-0.6, 0.6, 5)
    views = sv.five_viewpoints(np.array([0.018, 0.015, 0.01]), 0.2, roll, pattern="L")
    poses = truth.command_for(views @ shift)
    folder = write_pictures(tmp_path / "paper", truth, poses, target, samples=SAMPLES)
    assert len(list((folder / "images").iterdir())) == 10
    data = load_dataset(folder)
    assert data.view_count == 5
    assert data.observation_count == 5 * 2 * 42
    predicted = np.asarray(truth.project(poses, target.points)[0])
    gaps = [
        np.abs(np.asarray(data.pixels) - predicted[:, order]).max() for order in target.symmetries
    ]
    assert min(gaps) < 0.25


def test_pictures_of_several_heights_need_their_number(small_truth, tmp_path):
    truth = small_truth
    target = StackedTarget(CircleGrid(3, 3, 0.006), (0.0, 0.01))
    pose = truth.command_for(look_at_from_above(np.array([0.006, -0.006, 0.0]), 0.2, 0.1, 0.0))
    folder = write_pictures(tmp_path, truth, SE3(pose.wxyz_xyz[None]), target, samples=SAMPLES)
    text = (folder / "dataset.yaml").read_text()
    (folder / "dataset.yaml").write_text(text.replace("_{height}", ""))
    with pytest.raises(ValueError, match=r"2 heights need \{height\}"):
        load_dataset(folder)
    (folder / "dataset.yaml").write_text(text)
    (folder / "images/0_1.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"0_1\.png"):
        load_dataset(folder)


def test_exposure_scales_and_saturates():
    ramp = np.tile(np.linspace(0.0, 250.0, 26), (5, 1))
    picture = sensor_picture(ramp, blur=0.0, noise=0.0, exposure=2.0)
    np.testing.assert_array_equal(picture[0], np.minimum(2.0 * ramp[0], 255.0))


def test_noise_has_the_size_asked_for_and_its_seed():
    flat = np.full((200, 200), 100.0)
    picture = sensor_picture(flat, noise=3.0, seed=4)
    # Rounding adds 1/12 of a squared grey level.
    assert picture.std() == pytest.approx(np.sqrt(9.0 + 1.0 / 12.0), rel=0.02)
    np.testing.assert_array_equal(picture, sensor_picture(flat, noise=3.0, seed=4))
    assert (picture != sensor_picture(flat, noise=3.0, seed=5)).any()


def test_blur_keeps_the_light_of_a_point():
    point = np.zeros((21, 21))
    point[10, 10] = 5e3
    picture = sensor_picture(point, blur=2.0, noise=0.0).astype(float)
    assert picture.sum() == pytest.approx(5e3, rel=0.01)
    assert picture.max() == pytest.approx(5e3 / (2.0 * np.pi * 4.0), rel=0.02)
