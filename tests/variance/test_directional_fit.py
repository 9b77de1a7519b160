"""Fits of robots whose errors differ by direction, against the errors that were drawn."""

import dataclasses

import numpy as np
import pytest
from fit_scenes import MANY_VIEWS, scene_of
from scipy.linalg import expm

from smartview_jax import Rig, fit_joint, fit_rig
from smartview_jax.geometry import as_se3, host_matrices


def with_errors(scene, twists):
    """The data of a robot whose reported poses are off by these twists at the tool."""
    matrices = np.zeros((len(twists), 4, 4))
    matrices[:, :3, 3] = twists[:, :3]
    for rows, columns, k, sign in ((2, 1, 3, 1), (0, 2, 4, 1), (1, 0, 5, 1)):
        matrices[:, rows, columns] = sign * twists[:, k]
        matrices[:, columns, rows] = -sign * twists[:, k]
    reported = host_matrices(scene.data.base_from_tool) @ np.array([expm(m) for m in matrices])
    return dataclasses.replace(scene.data, base_from_tool=as_se3(reported))


@pytest.fixture(scope="module")
def scene():
    return scene_of(3, MANY_VIEWS)


@pytest.fixture(scope="module")
def worn(scene):
    """A worn joint turns the tool about an axis 0.3 m away: the twists, the data and their fit."""
    rng = np.random.default_rng(1)
    turns = np.outer(rng.normal(0.0, 5e-3, MANY_VIEWS), [0.0, 0.3, 0.0, 0.0, 0.0, 1.0])
    twists = turns + rng.normal(size=(MANY_VIEWS, 6)) * np.repeat([2e-5, 5e-5], 3)
    data = with_errors(scene, twists)
    return twists, data, fit_joint(data, scene.calibration)


def test_the_size_of_rotations_counts_what_translations_tell_too(worn):
    """The translations of a turn about a distant axis tell its angle."""
    twists, _, fit = worn
    estimate = fit.noise_estimate
    assert estimate is not None
    assert estimate.directions is not None
    sizes = np.sqrt(np.mean(twists.reshape(-1, 2, 3) ** 2, axis=(0, 2)))
    np.testing.assert_allclose([fit.noise.translation, fit.noise.rotation], sizes, rtol=0.35)
    largest = np.sqrt(np.mean(twists**2, axis=0))[[1, 5]]
    np.testing.assert_allclose(estimate.largest_pose_sigmas, largest, rtol=0.35)
    alike = estimate.alike
    assert alike is not None
    assert alike.directions is None
    shown = str(fit)
    assert f"{1e3 * estimate.largest_pose_sigmas[0]:.2g} mm" in shown
    assert "in their worst direction" in shown


def test_a_rig_of_one_camera_has_the_directions_of_the_camera_alone(scene, worn):
    """They differ by the bow of the board, which a rig does not ask for."""
    twists, data, alone = worn
    rig = fit_rig(Rig({"camera": data}), {"camera": scene.calibration})
    estimate, expected = rig.noise_estimate, alone.noise_estimate
    assert estimate is not None
    assert estimate.alike.directions is None
    # The translations along y follow the rotations about z.
    pairs = np.ix_(range(MANY_VIEWS), [1, 5], [1, 5])
    np.testing.assert_allclose(
        estimate.directions.covariance[pairs], expected.directions.covariance[pairs], rtol=0.05
    )
    noise = estimate.largest_noise
    found = [noise.translation, noise.rotation]
    np.testing.assert_allclose(found, expected.largest_pose_sigmas, rtol=0.02)
    assert f"{1e3 * noise.translation:.3f} mm and" in str(rig).split("on average")[1]
    # Predictions for the rig, and for one camera of it, know the directions, too.
    tool_from_base = host_matrices(data.base_from_tool)[:, :3, :3].swapaxes(1, 2)
    for fitted in (rig, rig.estimate("camera")):
        anywhere = fitted.noise.pose_covariances(tool_from_base)
        np.testing.assert_allclose(
            anywhere[pairs], expected.directions.covariance[pairs], rtol=0.05
        )
    # Twists, not the parameters along the axes of the errors.
    turns = rig.pose_corrections[:, 5]
    assert np.std(turns - twists[:, 5]) < 0.1 * np.std(twists[:, 5])
    for name in ("camera_from_tool.translation.x", "camera_from_tool.rotation.z"):
        assert rig.std[f"camera.{name}"] == pytest.approx(alone.std[name], rel=0.1)
    name = f"pose_corrections.{data.view_ids[3]}.rotation.z"
    assert rig.std[name] == pytest.approx(alone.std[name], rel=0.1)


def test_an_error_along_one_axis_is_judged_by_its_size_there(scene):
    """1.6 mm along the tool is implausible, though the mean over the axes is below the limit."""
    rng = np.random.default_rng(2)
    drawn = rng.normal(size=(MANY_VIEWS, 6)) * [5e-5, 5e-5, 1.6e-3, 5e-5, 5e-5, 5e-5]
    drawn[:, 2] *= 1.6e-3 / np.sqrt(np.mean(drawn[:, 2] ** 2))
    fit = fit_joint(with_errors(scene, drawn), scene.calibration)
    # Three standard deviations of the prior above its median.
    assert fit.noise.translation < 5e-5 * np.exp(3.0)
    assert "translation of reported poses in their worst direction" in " ".join(fit.warnings)


def test_without_smooth_errors_to_choose_directions_are_not_asked(scene):
    """A smooth error taken for noise would seem to have directions."""
    rng = np.random.default_rng(3)
    drawn = rng.normal(size=(MANY_VIEWS, 6)) * [2e-3, 5e-5, 5e-5, 5e-5, 5e-5, 5e-5]
    data = with_errors(scene, drawn)
    assert fit_joint(data, scene.calibration).noise_estimate.directions is not None
    assert fit_joint(data, scene.calibration, field=None).noise_estimate.directions is None
