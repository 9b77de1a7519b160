import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from scipy.spatial.transform import Rotation
from standard_scene import POINTS, VIEWS

from smartview_jax.simulation import (
    look_at_from_above,
    paper_calibration,
    random_scene,
    random_viewpoints,
    simulate,
)


def test_look_at_puts_the_target_on_the_optical_axis():
    target = np.array([0.1, -0.2, 0.3])
    pose = look_at_from_above(target, distance=0.5, tilt=0.4, azimuth=1.1, roll=-0.7)
    np.testing.assert_allclose(pose.apply(jnp.asarray(target)), [0.0, 0.0, 0.5], atol=1e-15)
    centre = pose.inverse().translation() - target
    assert float(jnp.linalg.norm(centre)) == pytest.approx(0.5)
    assert float(jnp.arccos(centre[2] / 0.5)) == pytest.approx(0.4)
    assert float(jnp.arctan2(centre[1], centre[0])) == pytest.approx(1.1)


def test_look_at_from_straight_above_has_u_along_x_and_v_along_minus_y():
    pose = look_at_from_above(np.zeros(3), 1.0, 0.0, 0.0)
    expected = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0])).as_matrix()
    np.testing.assert_allclose(pose.rotation().as_matrix(), expected, atol=1e-15)


def test_noise_has_the_stated_size():
    noise = {"pixel_noise": 0.3, "translation_noise": 1e-3, "rotation_noise": 2e-3}
    errors, corrections = [], []
    for seed in range(4):
        scene = random_scene(seed, VIEWS, POINTS, tilt=0.6, **noise)
        truth, _ = scene.calibration.project(scene.base_from_tool, scene.data.points)
        errors.append(np.asarray(scene.data.pixels - truth)[np.asarray(scene.data.visible)])
        # tool_from_base = exp(c) @ reported
        reported = scene.data.base_from_tool.inverse()
        corrections.append((scene.base_from_tool.inverse() @ reported.inverse()).log())
    assert np.concatenate(errors).std() == pytest.approx(0.3, rel=0.05)
    corrections = np.concatenate(corrections)
    assert corrections[:, :3].std() == pytest.approx(1e-3, rel=0.25)
    assert corrections[:, 3:].std() == pytest.approx(2e-3, rel=0.25)


def test_without_noise_the_data_are_the_projection():
    scene = random_scene(1, VIEWS, POINTS, pixel_noise=0.0)
    predicted, _ = scene.calibration.project(scene.data.base_from_tool, scene.data.points)
    seen = np.asarray(scene.data.visible)
    np.testing.assert_allclose(np.asarray(scene.data.pixels)[seen], predicted[seen], atol=1e-9)
    assert np.isnan(np.asarray(scene.data.pixels)[~seen]).all()


def test_outliers_are_marked_and_gross():
    scene = random_scene(2, VIEWS, POINTS, pixel_noise=0.1, outlier_fraction=0.1)
    truth, _ = scene.calibration.project(scene.base_from_tool, scene.data.points)
    seen, marked = np.asarray(scene.data.visible), np.asarray(scene.outliers)
    distance = np.linalg.norm(np.asarray(scene.data.pixels - truth), axis=-1)
    assert distance[seen & marked].min() > 4.0
    assert distance[seen & ~marked].max() < 1.0
    # A binomial share of some 330 points: three standard deviations.
    assert marked.sum() / seen.sum() == pytest.approx(0.1, abs=0.05)


def test_the_same_seed_gives_the_same_scene():
    first, second, other = (random_scene(seed, VIEWS, POINTS) for seed in (9, 9, 10))
    np.testing.assert_array_equal(first.data.pixels, second.data.pixels)
    assert not np.array_equal(first.base_from_tool.wxyz_xyz, other.base_from_tool.wxyz_xyz)


def test_points_behind_the_camera_are_not_seen():
    calibration = paper_calibration()
    away = random_viewpoints(
        np.random.default_rng(0), VIEWS, np.array([0.0, 0.0, 1.0]), (0.1, 0.2), 0.1
    )
    behind = POINTS + np.array([0.0, 0.0, 2.0])
    scene = simulate(calibration, calibration.command_for(away), behind)
    assert scene.data.observation_count == 0
    assert isinstance(scene.base_from_tool, SE3)
