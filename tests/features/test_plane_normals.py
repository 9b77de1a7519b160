"""The planes of segments, far from the optical axis, where every term counts."""

import numpy as np

import smartview_jax as sv
from smartview_jax.cameras import Pinhole
from smartview_jax.features.features import _plane_normals
from smartview_jax.features.ideal_plane import IdealPlane
from smartview_jax.features.segments import Lines

PLANE = IdealPlane(sv.Camera(600.0, 600.0, 319.5, 239.5, Pinhole(), (640, 480)))
OFFSET_SIGMA, ANGLE_SIGMA = 0.05, 2e-3


def line(offset=0.0, turn=0.0):
    """A line through (500, -300), moved across itself and turned about its centre."""
    normal = np.array([np.cos(0.4), np.sin(0.4)])
    centre = np.array([500.0, -300.0]) + offset * normal
    c, s = np.cos(turn), np.sin(turn)
    turned = np.array([[c, -s], [s, c]]) @ normal
    direction = np.array([-turned[1], turned[0]])
    ends = centre + np.array([[-20.0], [20.0]]) * direction
    one = np.ones(1)
    return Lines(
        centre[None],
        turned[None],
        ends[None],
        OFFSET_SIGMA**2 * one,
        ANGLE_SIGMA**2 * one,
        one,
        np.array([40]),
    )


def test_the_normal_is_at_a_right_angle_to_the_rays_of_the_ends():
    normals, _ = _plane_normals(line(), PLANE)
    assert np.abs(PLANE.rays(line().ends[0]) @ normals[0]).max() < 1e-12


def test_the_covariance_is_that_of_lines_moved_and_turned():
    rng = np.random.default_rng(0)
    sigmas = OFFSET_SIGMA, ANGLE_SIGMA
    samples = np.array(
        [
            _plane_normals(line(*(sigma * rng.standard_normal() for sigma in sigmas)), PLANE)[0][0]
            for _ in range(4000)
        ]
    )
    _, covariances = _plane_normals(line(), PLANE)
    sampled = np.cov(samples.T)
    # Three standard deviations of a variance from 4000 samples are 7 %.
    scale = np.abs(sampled).max()
    np.testing.assert_allclose(covariances[0], sampled, atol=0.07 * scale)
    assert np.linalg.norm(sampled - covariances[0]) < 0.05 * np.linalg.norm(sampled)
