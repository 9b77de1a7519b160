import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from shared_data import shared_pairs

from smartview_jax.simulation import PaperSetUp, paper_scene
from smartview_jax.staged import calibrate_views, estimate_view_poses
from smartview_jax.staged.weng import LINEAR_START, MEDIAN_ALPHA_START, PLANAR_START


@pytest.fixture(scope="module")
def exact():
    scene = paper_scene(0, PaperSetUp(pixel_noise=0.0))
    return scene, calibrate_views(scene.data.observations, (640, 480))


def test_points_at_several_heights_give_every_view_its_own_camera(exact):
    _, found = exact
    assert set(found.starts) == {LINEAR_START}
    np.testing.assert_allclose(found.intrinsics.alpha_u, 2133.0, rtol=1e-4)
    np.testing.assert_allclose(found.intrinsics.v0, 238.0, atol=0.1)
    np.testing.assert_allclose(found.intrinsics.k1, 0.7, atol=0.01)
    assert found.rms.max() < 0.01


def test_poses_are_found_with_the_camera(exact):
    scene, found = exact
    truth = scene.calibration.camera_from_world(scene.base_from_tool)
    np.testing.assert_allclose(found.camera_from_world.as_matrix(), truth.as_matrix(), atol=2e-4)


def test_gross_outliers_are_set_aside():
    scene = paper_scene(0, PaperSetUp(pixel_noise=0.1))
    pixels = scene.data.pixels.at[:, ::15].add(40.0)
    spoiled = eqx.tree_at(lambda o: o.pixels, scene.data.observations, pixels)
    found = calibrate_views(spoiled, (640, 480))
    visible = np.asarray(scene.data.visible)
    assert not np.asarray(found.inliers)[:, ::15].any()
    assert found.rms.max() < 0.2
    assert np.asarray(found.inliers).sum() == visible.sum() - visible[:, ::15].sum()


def test_one_plane_holds_the_centre_and_frontal_views_take_the_median():
    data, reference = shared_pairs("rct_circle10x10")
    found = calibrate_views(data.observations, data.image_size)
    assert PLANAR_START in found.starts
    assert MEDIAN_ALPHA_START in found.starts
    np.testing.assert_array_equal(found.intrinsics.u0, 319.5)
    np.testing.assert_array_equal(found.intrinsics.alpha_u, found.intrinsics.alpha_v)
    median = float(np.median(found.intrinsics.alpha_u))
    assert median == pytest.approx(reference["K"][0], rel=0.05)
    frontal = [k for k, start in enumerate(found.starts) if start == MEDIAN_ALPHA_START]
    assert len({float(found.intrinsics.alpha_u[k]) for k in frontal}) == 1


def test_views_are_located_with_a_known_camera(exact):
    scene, _ = exact
    poses, rms, used = estimate_view_poses(scene.data.observations, scene.calibration.camera)
    truth = scene.calibration.camera_from_world(scene.base_from_tool)
    np.testing.assert_allclose(poses.as_matrix(), truth.as_matrix(), atol=1e-8)
    assert rms.max() < 1e-6
    assert bool(jnp.all(used == scene.data.visible))
