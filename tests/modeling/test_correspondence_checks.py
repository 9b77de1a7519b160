import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3

from smartview_jax.engine import Noise
from smartview_jax.geometry import five_viewpoints, host_matrices
from smartview_jax.modeling import triangulate_points, wrong_correspondences
from smartview_jax.simulation import reported_poses

SIGMA, COUNT = 0.3, 6
"""Six features in five views or fewer: one program checks them all."""


@pytest.fixture(scope="module")
def poses(calibration):
    five = five_viewpoints(
        np.array([0.02, 0.0175, 0.01]), 0.2, roll=np.array([0.3, 0, -0.2, 0.5, 1.0])
    )
    return host_matrices(calibration.command_for(five))


def clicks(calibration, poses, count, seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform([0.008, 0.008, 0.0], [0.032, 0.027, 0.02], (count, 3))
    pixels = np.array(calibration.project(poses, points)[0])
    return pixels + SIGMA * rng.standard_normal(pixels.shape)


def test_right_clicks_are_named_as_rarely_as_stated(calibration, poses):
    """At a false-alarm probability of a half the rate shows in few runs; Bonferroni is a bound."""
    runs = [
        bool(wrong_correspondences(calibration, poses, clicks(calibration, poses, COUNT, seed),
                                   pixel_sigma=SIGMA, false_alarm=0.5))
        for seed in range(24)
    ]  # fmt: skip
    # Of 24 runs the mean of a half has a standard deviation of 0.1.
    assert 0.2 < np.mean(runs) < 0.7


def test_a_click_on_the_wrong_corner_is_named(calibration, poses):
    """Also where its own residual is not the largest of its point."""
    named, hidden = [], 0
    for seed in range(20):
        rng = np.random.default_rng((seed, 1))
        pixels = clicks(calibration, poses, COUNT, seed)
        # Of three views the wrong one's residual is the smaller one more often.
        visible = np.zeros((5, COUNT), dtype=bool)
        visible[: 5 if seed % 2 else 3] = True
        view, feature, angle = rng.integers(3), rng.integers(COUNT), rng.uniform(0, 2 * np.pi)
        pixels[view, feature] += 4.0 * np.array([np.cos(angle), np.sin(angle)])
        plain = triangulate_points(calibration, poses, pixels, visible, pixel_sigma=SIGMA)
        hidden += np.nanargmax(np.linalg.norm(plain.residuals[:, feature], axis=1)) != view
        wrong = wrong_correspondences(calibration, poses, pixels, visible, pixel_sigma=SIGMA)
        named.append(
            bool(wrong)
            and all(click.feature == feature for click in wrong)
            and any(view in (click.view, *click.instead) for click in wrong)
        )
        if named[-1] and wrong[0].view == view:
            assert wrong[0].distance == pytest.approx(4.0, abs=2.0)
            assert f"feature {feature} in view {view}" in str(wrong[0])
    assert np.mean(named) > 0.9
    assert hidden > 0


def test_two_wrong_clicks_are_both_named(calibration, poses):
    pixels = clicks(calibration, poses, COUNT, 3)
    pixels[1, 4] += [8.0, 3.0]
    pixels[3, 5] += [-2.0, 9.0]
    wrong = wrong_correspondences(calibration, poses, pixels, pixel_sigma=SIGMA)
    assert {(click.view, click.feature) for click in wrong} == {(1, 4), (3, 5)}
    assert all(click.p_value < 1e-6 for click in wrong)


def test_of_two_views_neither_can_be_acquitted(calibration, poses):
    pixels = clicks(calibration, poses, 3, 0)
    # Across the epipolar line of views 0 and 1: in that direction alone they can contradict.
    visible = np.ones((5, 3), dtype=bool)
    visible[2:, 1] = False
    for shift in ([8.0, 0.0], [0.0, 8.0]):
        moved = pixels.copy()
        moved[0, 1] += shift
        wrong = wrong_correspondences(calibration, poses, moved, visible, pixel_sigma=SIGMA)
        if wrong:
            break
    assert len(wrong) == 1
    assert {wrong[0].view, *wrong[0].instead} == {0, 1}
    assert np.isnan(wrong[0].distance)


def test_what_the_robots_noise_explains_is_not_named(calibration, poses):
    noise = Noise(0.15, 2e-4, 2e-3)
    named = {"known": 0, "unknown": 0}
    for seed in range(6):
        reported = host_matrices(
            reported_poses(
                SE3.from_matrix(jnp.asarray(poses)),
                np.random.default_rng(seed),
                noise.translation,
                noise.rotation,
            )
        )
        pixels = clicks(calibration, poses, COUNT, seed)
        for key, stated in (("known", noise), ("unknown", None)):
            named[key] += bool(
                wrong_correspondences(
                    calibration, reported, pixels, noise=stated, pixel_sigma=SIGMA
                )
            )
    assert named["unknown"] >= 5
    assert named["known"] == 0
