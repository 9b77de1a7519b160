"""Depths at the points: their noise by restricted likelihood, outliers, and what is refused."""

import dataclasses

import numpy as np
import pytest
from depth_scene import NOISE, depth_scene
from scipy.optimize import minimize

import smartview_jax as sv
from smartview_jax.dataset import DepthNoise


def boards(seed, views=30, noise=NOISE):
    """Depths of tilted boards of 5 x 4 points, from 0.3 to 1.5 m, and the points."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(0.02 * np.arange(5), 0.02 * np.arange(4))
    points = np.stack([x.ravel(), y.ravel(), 0.0 * x.ravel()], axis=-1)
    middle, slopes = rng.uniform(0.3, 1.5, (views, 1)), rng.uniform(-0.5, 0.5, (views, 2))
    exact = middle + slopes @ points[:, :2].T
    return points, exact, exact + noise.std(exact) * rng.normal(size=exact.shape)


def dataset(points, views):
    pixels = np.full((views, len(points), 2), 100.0)
    return sv.Dataset.from_arrays(points, pixels, np.tile(np.eye(4), (views, 1, 1)), (640, 480))


def test_the_noise_is_the_likeliest():
    points, _, depths = boards(0)
    actual = dataset(points, len(depths)).with_depths(depths).depth_noise
    design = np.column_stack([np.ones(len(points)), points[:, :2]])
    off = depths.T - design @ np.linalg.lstsq(design, depths.T, rcond=None)[0]
    sums, middle = np.square(off).sum(axis=0), np.median(depths, axis=1)

    def deviance(log_parts):
        variances = np.exp(log_parts[0]) + np.exp(log_parts[1]) * middle**4
        return (17 * np.log(variances) + sums / variances).sum()

    best = minimize(deviance, np.log([1e-7, 1e-6]), method="Nelder-Mead", options={"xatol": 1e-6})
    expected = np.exp(0.5 * best.x)
    np.testing.assert_allclose([actual.constant, actual.quadratic], expected, rtol=0.02)
    # Over many boards it is the true one.
    many = [dataset(points, 30).with_depths(boards(seed)[2]).depth_noise for seed in range(20)]
    assert np.mean([noise.constant for noise in many]) == pytest.approx(NOISE.constant, rel=0.1)
    assert np.mean([noise.quadratic for noise in many]) == pytest.approx(NOISE.quadratic, rel=0.03)


def test_outliers_have_no_weight_and_a_stated_noise_is_taken():
    points, exact, depths = boards(1)
    rng = np.random.default_rng(2)
    wrong = rng.random(depths.shape) < 0.1
    spoilt = depths + np.where(wrong, rng.choice([-0.1, 0.1], depths.shape), 0.0)
    spoilt[3, 4] = np.nan
    data = dataset(points, len(depths)).with_depths(spoilt, NOISE)
    assert data.depths is not None
    used = data.depths.used
    assert not used[wrong].any()
    assert not used[3, 4]
    assert used[~wrong].mean() > 0.99
    assert f"{599 - used.sum()} of 599 depths are far from the plane" in data.notes[-1]
    assert data.depth_noise is NOISE
    # The standard deviation is the one at the plane through the board's depths.
    stds = 1.0 / np.asarray(data.depths.precision)[used]
    np.testing.assert_allclose(stds, NOISE.std(exact)[used], rtol=0.02)
    estimated = dataset(points, len(depths)).with_depths(spoilt).depth_noise
    assert estimated is not None
    assert estimated.quadratic == pytest.approx(NOISE.quadratic, rel=0.1)


def test_views_are_selected_with_their_depths():
    scene = depth_scene(0)
    data = scene.data.with_depths(scene.depths)
    assert data.depths is not None
    chosen = data.select([2, 5]).depths
    np.testing.assert_array_equal(chosen.measured, np.asarray(data.depths.measured)[[2, 5]])
    padded = dataclasses.replace(data.observations).padded_to(10, 16).depths
    assert padded.measured.shape == (10, 16)
    assert data.with_depths(None).depths is None
    assert f", {data.depths.used.sum()} with a depth" in repr(data)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda z: z[:, :3], r"expected shape \(8, 14\).*found \(8, 3\)"),
        (
            lambda z: np.where(np.isnan(z), -1.0, z),
            r"point \d+: expected above 0 m, found -1",
        ),
        (lambda z: 1e3 * z, "millimetres given as metres"),
        (lambda z: np.full_like(z, np.nan), "expected 8 or more beyond three a view.*found 0"),
    ],
)
def test_wrong_depths_are_named(change, message):
    scene = depth_scene(0)
    with pytest.raises(ValueError, match=message):
        scene.data.with_depths(change(scene.depths))


def test_impossible_noise_is_named():
    with pytest.raises(ValueError, match="expected numbers of at least 0, not both 0"):
        DepthNoise(0.0, 0.0)


def test_a_batch_of_fits_says_that_it_takes_none():
    scene = depth_scene(0)
    data = scene.data.with_depths(scene.depths)
    with pytest.raises(ValueError, match=r"data\[0\]: depths count in fit_joint"):
        sv.fit_many([data], scene.truth)
