"""Run one pass of the Kalman filter of Step 2: linearise, update with all measurements, step.

The residuals are linear in the change x of the state, `r = J x + noise`. Scaled by the initial
standard deviations, x has the initial covariance I.

Poses are parameterised by a rotation about the centroid of the visible points. For one plane seen
from similar directions the cost has a narrow valley, in which focal length, distance and tilt vary
together. With rotations about the camera the target is displaced as it tilts; the valley is then
curved, and linearised passes advance along it very slowly.

The linearisation and the updates are one compiled program. The rest of a pass is a few operations
on small arrays, for which NumPy is enough.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxlie import SE3
from jaxtyping import Array, Bool, Float
from scipy.spatial.transform import Rotation

from ..cameras import Camera
from ..dataset import Observations
from ..geometry import host_matrices
from ..runtime.compilation import compiled_optimised
from .kalman_update import (
    FilterState,
    absorb_measurements,
    standard_normal_state,
    whole_covariance,
    whole_mean_and_variances,
)

_HELD_SCALE = 1e-12
"""Factor of the initial standard deviations of a camera that is held.

It keeps its columns, with a variance of practically zero, so that one program serves both cases."""


class PassResult(NamedTuple):
    """The result of one pass over all measurements.

    Attributes:
        camera, camera_from_world: the state after the pass.
        max_change: largest change of the state, in its own standard deviations.
        distribution: distribution of the change, in units of the initial standard deviations.
        camera_scale, pose_scale: these standard deviations, `(camera)` and `(views, 6)`.
        centroids: points about which the poses are rotated, camera frame, m.
    """

    camera: Camera
    camera_from_world: SE3
    max_change: float
    distribution: FilterState
    camera_scale: np.ndarray
    pose_scale: np.ndarray
    centroids: np.ndarray

    def covariance(self) -> Float[np.ndarray, "state state"]:
        """Return the covariance of the camera's numbers and of pose tangents about the camera."""
        # A tangent x about the centroid m is Ad(m) x about the camera; for a translation m
        #   Ad(m) = [ I  [m]x ]
        #           [ 0  I    ].
        adjoints = np.tile(np.eye(6), (len(self.centroids), 1, 1))
        adjoints[:, :3, 3:] = np.cross(self.centroids[:, None], np.eye(3)).swapaxes(1, 2)
        return whole_covariance(
            self.distribution, self.camera_scale, adjoints * self.pose_scale[:, None]
        )


class PassSettings(NamedTuple):
    """The numbers by which a pass weighs its measurements.

    Attributes:
        pixel_sigma: standard deviation of u and of v, px.
        gate: largest squared innovation of each view, relative to its covariance; infinite for no
            gate.
        variance_scale: factor of the initial variances.
        hold_camera: treat the camera as known.
    """

    pixel_sigma: float
    gate: Float[np.ndarray, "views"]
    variance_scale: float
    hold_camera: bool


class LinearisationPoint(NamedTuple):
    """The state about which the projections are linearised, and the initial standard deviations.

    Attributes:
        camera: the camera.
        in_camera: points in the camera frame, m.
        centroids: points about which the poses are rotated, camera frame, m.
        residuals: measured minus predicted, px.
        camera_factor: factor of the camera's initial standard deviations.
        pose_scale: initial standard deviations of the poses.
    """

    camera: Camera
    in_camera: Float[Array | np.ndarray, "views points 3"]
    centroids: Float[Array | np.ndarray, "views 3"]
    residuals: Float[Array | np.ndarray, "views points 2"]
    camera_factor: Float[Array | np.ndarray, ""]
    pose_scale: Float[Array | np.ndarray, "views 6"]


def run_pass(
    observations: Observations,
    camera: Camera,
    camera_from_world: SE3,
    residuals: Float[np.ndarray, "views points 2"],
    inliers: Bool[np.ndarray, "views points"],
    settings: PassSettings,
) -> PassResult:
    """Update the state with all measurements once, from the wide initial covariance.

    Args:
        observations: points and visibility.
        camera, camera_from_world: the linearisation point.
        residuals: measured minus predicted there, px.
        inliers: the measurements used.
        settings: their weights.
    """
    matrices = host_matrices(camera_from_world)
    rotations, translations = matrices[:, :3, :3], matrices[:, :3, 3]
    in_camera = np.asarray(observations.points) @ rotations.swapaxes(1, 2) + translations[:, None]
    visible = np.asarray(observations.visible)
    seen = np.where(visible[..., None], in_camera, 0.0)
    centroids = seen.sum(axis=1) / np.maximum(visible.sum(axis=1), 1)[:, None]
    # Poses: half the distance (m) for the translation, half a radian for the rotation.
    distances = np.linalg.norm(translations, axis=1, keepdims=True)
    damping = np.sqrt(settings.variance_scale)
    pose_scale = damping * np.repeat(
        np.hstack([0.5 * distances, np.full_like(distances, 0.5)]), 3, 1
    )
    camera_factor = np.array(damping * (_HELD_SCALE if settings.hold_camera else 1.0))
    new_camera, camera_scale, distribution = _linearised_pass(
        LinearisationPoint(camera, in_camera, centroids, residuals, camera_factor, pose_scale),
        inliers & visible,
        np.array(settings.pixel_sigma),
        settings.gate,
    )
    change, variances = whole_mean_and_variances(distribution)
    # Both are relative to the initial standard deviations, which cancel in the ratio.
    max_change = float(np.max(np.abs(change) / np.sqrt(np.maximum(variances, 1e-30))))
    if np.isfinite(max_change):
        steps = change[len(camera_scale) :].reshape(-1, 6) * pose_scale
        camera_from_world = _moved(camera_from_world, centroids, steps)
    return PassResult(
        new_camera,
        camera_from_world,
        max_change,
        distribution,
        np.asarray(camera_scale),
        pose_scale,
        centroids,
    )


@compiled_optimised
def _linearised_pass(
    point: LinearisationPoint,
    used: Bool[Array | np.ndarray, "views points"],
    pixel_sigma: Float[Array | np.ndarray, ""],
    gate: Float[Array | np.ndarray, "views"],
) -> tuple[Camera, Float[Array, "camera"], FilterState]:
    """Linearise the projections and update with all measurements.

    Args:
        point: the linearisation point.
        used: the measurements used.
        pixel_sigma, gate: as in `PassSettings`.

    Returns:
        The camera after the pass, its initial standard deviations, and the distribution of the
        change in units of the initial standard deviations.
    """
    numbers, rebuild = ravel_pytree(point.camera)
    measurements, camera_scale = scaled_measurements(point)
    # The filter takes the measurements point by point over all views.
    distribution = absorb_measurements(
        standard_normal_state(len(used), len(numbers)),
        jnp.swapaxes(measurements / pixel_sigma, 0, 1),
        jnp.swapaxes(used, 0, 1),
        gate,
    )
    return rebuild(numbers + camera_scale * distribution.camera[:, -1]), camera_scale, distribution


def scaled_measurements(
    point: LinearisationPoint,
) -> tuple[Float[Array, "views points 2 columns"], Float[Array, "camera"]]:
    """Return the measurements `[H_e H_s -z]`, px, for a change in initial standard deviations.

    The camera's initial standard deviations are returned too.
    """
    camera, in_camera, centroids, residuals, camera_factor, pose_scale = point
    width, height = camera.image_size
    # The picture's corner as a ray with z = 1, half the picture from the optical axis.
    corner = jnp.stack([width / camera.alpha_u, height / camera.alpha_v, jnp.asarray(2.0)]) / 2.0
    by_camera, by_point = _projection_jacobians(
        camera, jnp.concatenate([in_camera.reshape(-1, 3), corner[None]])
    )
    camera_scale = _camera_standard_deviations(camera, by_camera[-1, :, 4:]) * camera_factor
    by_camera = by_camera[:-1].reshape(*residuals.shape, -1)
    by_point = by_point[:-1].reshape(*residuals.shape, 3)
    # A twist (v, w) about the centroid c moves a point p by dp = v + w x q, with q = p - c. With
    # g = du/dp this gives du = g . v + (q x g) . w.
    arms = in_camera - centroids[:, None]
    by_pose = jnp.concatenate([by_point, jnp.cross(arms[:, :, None], by_point)], axis=-1)
    columns = [
        by_pose * pose_scale[:, None, None],
        by_camera * camera_scale[None, None, None],
        -residuals[..., None],
    ]
    return jnp.concatenate(columns, axis=-1), camera_scale


def _projection_jacobians(
    camera: Camera, points: Float[Array, "points 3"]
) -> tuple[Float[Array, "points 2 camera"], Float[Array, "points 2 3"]]:
    """Return the derivatives of the pixels by the camera and by the points.

    The projection is given by the collinearity equations Eq. 5 and Eq. 6 with the lens. (Eq. 7
    prints t_x in the rows where t_y and t_z belong, a misprint.)
    """
    numbers, rebuild = ravel_pytree(camera)
    # A lens that solves an equation solves it once, because the projection is linearised once.
    # Points are independent, so that one tangent gives the derivative of every point.
    _, linear = jax.linearize(lambda n, p: rebuild(n).project(p)[0], numbers, points)
    by_camera = jax.vmap(lambda n: linear(n, jnp.zeros_like(points)))(jnp.eye(len(numbers)))
    by_point = jax.vmap(
        lambda axis: linear(jnp.zeros_like(numbers), jnp.broadcast_to(axis, points.shape))
    )(jnp.eye(3))
    return jnp.moveaxis(by_camera, 0, -1), jnp.moveaxis(by_point, 0, -1)


def _camera_standard_deviations(
    camera: Camera, corner_jacobian: Float[Array, "2 lens"]
) -> Float[Array, "camera"]:
    """Return the initial standard deviations of the camera's numbers.

    They are wide because the start from Step 1 was computed from the same pixels: a quarter of
    alpha; for u0, v0 a quarter of the picture's size; for a lens coefficient the change that
    displaces the picture's corner by a quarter of the width, not below 1.

    Args:
        camera: the camera at the linearisation point.
        corner_jacobian: derivatives of the corner's pixel by the lens coefficients.
    """
    width, height = camera.image_size
    pinhole = jnp.stack([camera.alpha_u, camera.alpha_v, jnp.asarray(width), jnp.asarray(height)])
    displacement = jnp.max(jnp.abs(corner_jacobian), axis=0)
    # Outside the domain of the lens the derivative at the corner is zero or NaN; use 1 there.
    lens = jnp.where(
        displacement > 1e-6 * width, jnp.maximum(0.25 * width / displacement, 1.0), 1.0
    )
    return jnp.concatenate([0.25 * pinhole, lens])


def _moved(camera_from_world: SE3, centroids: np.ndarray, steps: np.ndarray) -> SE3:
    """Return the poses after a translation and a rotation about the centroids.

    Translation and rotation are applied separately. The exponential of the whole twist is a screw
    motion, in which a target that recedes is also displaced sideways.
    """
    numbers = np.asarray(camera_from_world.wxyz_xyz)
    turns = Rotation.from_rotvec(steps[:, 3:])
    rotations = turns * Rotation.from_quat(numbers[:, :4], scalar_first=True)
    translations = centroids + steps[:, :3] + turns.apply(numbers[:, 4:] - centroids)
    return SE3(jax.device_put(np.hstack([rotations.as_quat(scalar_first=True), translations])))
