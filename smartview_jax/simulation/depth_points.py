"""Simulate a depth sensor: points of a target, or depths at them, with bias and noise."""

import numpy as np
from jaxtyping import Float

from ..calibration import DepthBias
from ..dataset import DepthNoise, DepthSensor
from ..geometry import host_transformed

WRONG_POINT_SIGMA = 0.02
"""Standard deviation of a coordinate of a wrong point, m."""


def simulate_depth_points(
    camera_from_world: Float[np.ndarray, "views 4 4"],
    target_points: Float[np.ndarray, "points 3"],
    sensor: DepthSensor,
    rng: np.random.Generator,
    wrong: float = 0.0,
    missing: float = 0.1,
) -> Float[np.ndarray, "views points 3"]:
    """Return the points of a target as a depth sensor measures them in its frame, m.

    Args:
        camera_from_world: poses of the target in the sensor's frame.
        target_points: points of the target in its own frame, m.
        sensor: true bias and noise; standard deviations of the bias have no effect.
        rng: source of the noise.
        wrong: share of the points that are off by centimetres.
        missing: share of the points that are not measured, which are NaN.

    For example:

        >>> from smartview_jax.dataset import DepthSensor
        >>> far, one = np.eye(4)[None], np.zeros((1, 3))
        >>> far[0, 2, 3] = 0.5
        >>> exact = DepthSensor(1.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        >>> rng = np.random.default_rng(0)
        >>> sv.simulation.simulate_depth_points(far, one, exact, rng, missing=0.0).round(4).tolist()
        [[[0.0, 0.0, 0.4902]]]
    """
    points = host_transformed(camera_from_world, np.asarray(target_points))
    depth = points[..., 2:]
    points = points * ((depth - sensor.offset) / sensor.scale / depth)
    rays = points / np.linalg.norm(points, axis=2, keepdims=True)
    noise = (sensor.across_std or 0.0) * rng.normal(size=points.shape)
    along = sensor.along_std * rng.normal(size=depth.shape)
    noise += rays * (along - (noise * rays).sum(axis=2, keepdims=True))
    is_wrong = rng.random(points.shape[:2]) < wrong
    noise[is_wrong] += WRONG_POINT_SIGMA * rng.normal(size=(int(is_wrong.sum()), 3))
    points = points + noise
    points[rng.random(points.shape[:2]) < missing] = np.nan
    return points


def simulate_depths(
    camera_from_world: Float[np.ndarray, "views 4 4"],
    target_points: Float[np.ndarray, "*views points 3"],
    bias: DepthBias,
    noise: DepthNoise,
    rng: np.random.Generator,
    missing: float = 0.1,
) -> Float[np.ndarray, "views points"]:
    """Return the depths that a camera measures at the points of a target, m; NaN where missing.

    Args:
        camera_from_world: poses of the target in the camera's frame.
        target_points: points of the target in its own frame, of all views or of each, m.
        bias: true bias of the depths.
        noise: their true noise; its common part is one error for all depths of a view.
        rng: source of the noise.
        missing: share of the points without a depth.

    For example:

        >>> from smartview_jax.calibration import DepthBias
        >>> from smartview_jax.dataset import DepthNoise
        >>> far, middle = np.eye(4)[None], np.zeros((1, 3))
        >>> far[0, 2, 3] = 0.5
        >>> bias, exact = DepthBias(1.02), DepthNoise(1e-9)
        >>> rng = np.random.default_rng(0)
        >>> sv.simulation.simulate_depths(far, middle, bias, exact, rng, 0.0).round(4).tolist()
        [[0.4902]]
    """
    exact = host_transformed(camera_from_world, np.asarray(target_points))[..., 2]
    depths = np.array(bias.measured(exact)) + noise.std(exact) * rng.normal(size=exact.shape)
    depths[rng.random(exact.shape) < missing] = np.nan
    return depths + (noise.common or 0.0) * rng.normal(size=(len(depths), 1))
