"""A camera that measures depths too: small scenes whose depths are biased and noisy."""

import dataclasses
import functools
from typing import NamedTuple

import numpy as np
from fit_scenes import scene_of

from smartview_jax.calibration import Calibration, DepthBias
from smartview_jax.dataset import Dataset, DepthNoise
from smartview_jax.geometry import host_matrices
from smartview_jax.simulation import simulate_depths

BIAS = DepthBias(1.02, 1e-3)
NOISE = DepthNoise(2e-4, 2e-3)


class DepthScene(NamedTuple):
    """A scene with its true calibration, its pixels, and what a depth sensor measures."""

    truth: Calibration
    data: Dataset
    depths: np.ndarray


def assert_bias_recovered(sensor):
    """Chi-square with two degrees of freedom: one in ten thousand is beyond."""
    off = np.array([sensor.scale - float(BIAS.scale), sensor.offset - float(BIAS.offset)])
    assert off @ np.linalg.solve(sensor.covariance, off) < 18.4
    assert abs(off[0]) < 0.1 * (float(BIAS.scale) - 1.0)


@functools.cache
def depth_scene(seed, views=8, common=0.0, **noise):
    """The standard scene with depths, where a tenth is missing.

    Args:
        seed, views, noise: as in `scene_of`.
        common: standard deviation of the error that all depths of a view have in common, m.
    """
    scene = scene_of(seed, views, **noise)
    poses = host_matrices(scene.calibration.camera_from_world(scene.base_from_tool))
    rng = np.random.default_rng((seed, 3))
    noise_of_depths = dataclasses.replace(NOISE, common=common)
    depths = simulate_depths(poses, np.asarray(scene.data.points), BIAS, noise_of_depths, rng)
    return DepthScene(scene.calibration, scene.data, depths)
