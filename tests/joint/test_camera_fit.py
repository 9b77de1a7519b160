"""Step 2 as a batch, against OpenCV and against the filter."""

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from fit_scenes import VIEWS, scene_of
from jaxlie import SE3

import smartview_jax as sv
from smartview_jax.cameras import Camera, OpenCV5
from smartview_jax.joint import batch_least_squares, fit_camera
from smartview_jax.simulation import paper_points, random_scene
from smartview_jax.staged import CommonCameraOptions, kalman_filter


@pytest.fixture(scope="module")
def scene():
    return scene_of(6)


@pytest.fixture(scope="module")
def start(scene):
    """The truth, moved by what Step 1 may be wrong by."""
    rng = np.random.default_rng(3)
    twists = jnp.asarray(rng.normal(size=(VIEWS, 6)) * np.repeat([2e-3, 1e-2], 3))
    poses = scene.calibration.camera_from_world(scene.base_from_tool)
    camera = eqx.tree_at(lambda c: c.alpha_u, scene.calibration.camera, jnp.asarray(2160.0))
    return camera, SE3.exp(twists) @ poses


def test_the_camera_fit_is_the_optimum_that_the_filter_settles_at(scene, start):
    batch = fit_camera(scene.data, *start)
    kalman = kalman_filter(scene.data.observations, *start)
    assert batch.converged
    assert kalman.converged
    std = np.array([batch.std[name] for name in batch.parameter_names])
    ours, theirs = (
        np.array([float(c.alpha_u), float(c.alpha_v), float(c.u0), float(c.v0), float(c.lens.k1)])
        for c in (batch.camera, kalman.camera)
    )
    assert np.abs((ours - theirs) / std).max() < 0.1
    scale = (batch.pixel_sigma / float(kalman.pixel_sigma)) ** 2
    np.testing.assert_allclose(np.sqrt(np.diag(kalman.covariance)[:5] * scale), std, rtol=0.025)
    assert batch.pixel_sigma == pytest.approx(0.15, rel=0.05)


def test_opencv_finds_the_same_camera_and_poses(scene, start):
    flat = random_scene(6, VIEWS, paper_points((0.0,))[::3])
    seen = np.asarray(flat.data.visible)
    points = [np.asarray(p, np.float32)[s] for p, s in zip(flat.data.points, seen, strict=True)]
    pixels = [np.asarray(p, np.float32)[s] for p, s in zip(flat.data.pixels, seen, strict=True)]
    rms, K, _, turns, shifts = cv2.calibrateCamera(
        points, pixels, (640, 480), None, None, criteria=(3, 1000, 1e-15)
    )
    lens = OpenCV5(*(jnp.asarray(0.0) for _ in range(5)))
    poses = flat.calibration.camera_from_world(flat.base_from_tool)
    fit = fit_camera(flat.data, Camera(2100.0, 2100.0, 320.0, 240.0, lens, (640, 480)), poses)
    assert fit.converged
    # OpenCV stops a little early and rounds pixels to single precision.
    assert fit.rms == pytest.approx(rms, rel=1e-5)
    for name, value in zip(
        ("alpha_u", "alpha_v", "u0", "v0"), K[[0, 1, 0, 1], [0, 1, 2, 2]], strict=True
    ):
        assert abs(float(getattr(fit.camera, name)) - value) < 0.05 * fit.std[f"camera.{name}"]
    there = fit.camera_from_world
    np.testing.assert_allclose(there.translation(), np.squeeze(shifts, -1), atol=2e-5)
    rotations = np.stack([cv2.Rodrigues(turn)[0] for turn in turns])
    np.testing.assert_allclose(there.rotation().as_matrix(), rotations, atol=1e-4)


def test_outliers_are_set_aside_and_good_points_kept(start):
    scene = scene_of(6, outlier_fraction=0.1)
    fit = batch_least_squares(scene.data.observations, *start)
    assert fit.converged
    assert not np.asarray(fit.inliers & scene.outliers).any()
    lost = scene.data.visible & ~scene.outliers & ~fit.inliers
    assert int(jnp.sum(lost)) <= 2
    # Five numbers of the camera and six of every view are fitted; the sigma is told by the rest.
    used = 2 * int(jnp.sum(fit.inliers))
    dof = used - 5 - 6 * VIEWS
    expected = 0.15 * np.sqrt(2.0 * dof / used)
    assert fit.rms == pytest.approx(expected, rel=3.0 / np.sqrt(2.0 * dof))


def test_a_point_that_cannot_be_projected_is_set_aside(scene, start):
    behind = scene.data.points.at[1, 3, 2].add(1.0)
    data = eqx.tree_at(lambda d: d.points, scene.data, behind)
    fit = batch_least_squares(data.observations, *start)
    assert fit.converged
    assert not bool(fit.inliers[1, 3])
    assert int(jnp.sum(data.visible & ~fit.inliers)) <= 2


def test_a_known_camera_is_held_and_a_blind_view_keeps_its_pose(scene, start):
    hidden = scene.data.visible.at[2].set(False)
    data = eqx.tree_at(lambda d: d.visible, scene.data, hidden)
    camera = scene.calibration.camera
    fit = batch_least_squares(
        data.observations, camera, start[1], options=CommonCameraOptions(hold_camera=True)
    )
    assert fit.converged
    assert fit.parameter_names == ()
    assert eqx.tree_equal(fit.camera, camera)
    np.testing.assert_allclose(fit.camera_from_world.wxyz_xyz[2], start[1].wxyz_xyz[2], atol=1e-15)
    assert "pose_corrections.2.translation.x" not in fit.std
    truth = scene.calibration.camera_from_world(scene.base_from_tool)
    error = np.asarray((fit.camera_from_world @ truth.inverse()).log())
    parts = [f"{part}.{axis}" for part in ("translation", "rotation") for axis in "xyz"]
    std = [[fit.std[f"pose_corrections.{v}.{p}"] for p in parts] for v in range(VIEWS) if v != 2]
    # At the camera, where the corrections act: 42 numbers, and one in 10 000 is this far off.
    assert np.abs(np.delete(error, 2, axis=0) / std).max() < 4.5
    assert np.abs(np.delete(error, 2, axis=0) / std).max() > 0.5


def test_calibrate_may_start_from_the_batch(scene):
    by_filter = sv.calibrate(scene.data, "radial", noise="trusted")
    by_batch = sv.calibrate(scene.data, "radial", noise="trusted", step2="batch")
    assert by_batch.result.converged
    gap = by_batch.calibration.camera_from_tool.inverse() @ by_filter.calibration.camera_from_tool
    assert float(jnp.linalg.norm(gap.log())) < 1e-5
    with pytest.raises(ValueError, match="step2 is one of kalman, batch; found 'guess'"):
        sv.calibrate(scene.data, noise="trusted", step2="guess")
