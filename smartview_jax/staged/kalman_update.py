"""Update a camera and the poses of many views with one two-dimensional measurement at a time.

A Kalman filter keeps the mean and the covariance P of its whole state. A measurement z of a view
concerns the camera s and the pose e of this view only, `z = H_s s + H_e e + noise`, yet in the form
of the textbook it changes all of P, because the camera correlates all views:

    S = H P H' + N                      covariance of the innovation
    K = P H' S^-1                       gain
    mean <- mean + K (z - H mean)
    P <- P - K H P

For a known camera, however, the views are independent of each other. The same normal distribution
is therefore kept here as the camera's own, and one of each pose e^v given the camera:

    s ~ N(m, C),        e^v | s ~ N(a_v + G_v s, D_v).

A measurement changes this in two steps, by `p(z, e | s) p(s) = p(e | s, z) p(z | s) p(s)`. With
`h = H_s + H_e G` the innovation of the pose is `z - H_e a - h s` for a known camera. Its covariance
and the gain follow, with which the pose given the camera is updated:

    S_e = H_e D H_e' + N,       K_e = D H_e' S_e^-1
    a <- a - K_e (H_e a - z)
    G <- G - K_e h
    D <- D - K_e H_e D.

What p(z | s) leaves is a measurement of the camera, `z - H_e a = h s + noise` with noise N(0, S_e):

    S = h C h' + S_e,           K_s = C h' S^-1
    m <- m - K_s (h m + H_e a - z)
    C <- C - K_s h C.

The other views stay as they are. S is the S of the textbook, and `h m + H_e a - z` is its
innovation with the sign reversed, so that an outlier gate decides alike. Nothing is inverted but
S_e and S: a camera that is held by a variance of practically zero remains exact.

Both steps have one form. Let B be `[D G a]` or `[C m]`, R the rows `[0 H_s -z]` or `[0 H_e a - z]`,
and LL' the Cholesky factor of S_e or S:

    W = L^-1 (H B + R)
    B <- B - (the left, square part of W)' W.

The whole state is assembled once, after the last measurement: `e = a + G s + noise` has the mean
`a + G m` and, with s, the covariance `[I; G] C [I G']` plus D in the block of its view.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

_DETERMINED_VARIANCE = 25.0
"""Variance of a predicted pixel, u and v together, in units of the noise's, below which it gates.

Until then, and until four points of the view have been used, its predictions are poor, and good
points would be rejected."""

_DETERMINED_POINTS = 4
"""Number of points that determine the pose of a view for a known camera."""

POSE_SIZE = 6
"""Number of parameters of a pose."""


class FilterState(NamedTuple):
    """The distribution of the camera, and of every pose given the camera.

    Attributes:
        camera: `[C m]`, covariance and mean of the camera.
        poses: `[D_v G_v a_v]`, of each pose for a known camera s the covariance D, and the mean
            `a + G s`.
    """

    camera: Float[Array, "camera camera_columns"]
    poses: Float[Array, "views 6 columns"]


def standard_normal_state(views: int, camera_size: int) -> FilterState:
    """Return the state in which all numbers are independent, with mean zero and variance one."""
    pose = jnp.eye(POSE_SIZE, POSE_SIZE + camera_size + 1)
    return FilterState(
        jnp.eye(camera_size, camera_size + 1), jnp.broadcast_to(pose, (views, *pose.shape))
    )


def absorb_measurements(
    state: FilterState,
    measurements: Float[Array, "points views 2 columns"],
    used: Bool[Array, "points views"],
    gate: Float[Array | np.ndarray, "views"],
) -> FilterState:
    """Update the state with all measurements, point by point over all views, not view by view.

    In this order the camera is determined early, and gating can begin.

    Args:
        state: distribution before.
        measurements: `[H_e H_s -z]`, divided by the standard deviation of the noise.
        used: the measurements that are not to be skipped.
        gate: a measurement of a view is rejected whose squared innovation, relative to its
            covariance, is larger, once the view is determined; infinite for no gate.
    """
    points, views = used.shape
    measurements = measurements.reshape(points * views, *measurements.shape[2:])
    # Those that are used come first, in their order.
    order = jnp.argsort(~used.ravel(), stable=True)
    enough = jnp.uint8(_DETERMINED_POINTS)

    def absorb(number: Array, carry: tuple) -> tuple:
        """Update the camera and the pose of one view, unless the measurement is gated out."""
        camera, poses, counts = carry
        measured = order[number]
        view = measured % views
        pose, count = poses[view], counts[view]
        new_camera, new_pose, squared_innovation, variance = _update(
            camera, pose, measurements[measured]
        )
        determined = (variance < _DETERMINED_VARIANCE) & (count == enough)
        accepted = (squared_innovation <= gate[view]) | ~determined
        more = jnp.minimum(count + jnp.uint8(1), enough)
        return (
            jnp.where(accepted, new_camera, camera),
            poses.at[view].set(jnp.where(accepted, new_pose, pose)),
            counts.at[view].set(jnp.where(accepted, more, count)),
        )

    # Of all carried arrays XLA copies this one for every measurement, so it is kept small: one byte
    # a view, in which nothing is counted beyond what determines a pose.
    counts = jnp.zeros(views, jnp.uint8)
    camera, poses, _ = jax.lax.fori_loop(0, jnp.sum(used), absorb, (*state, counts))
    return FilterState(camera, poses)


def _update(
    camera: Float[Array, "camera camera_columns"],
    pose: Float[Array, "6 columns"],
    measurement: Float[Array, "2 columns"],
) -> tuple[Array, Array, Float[Array, ""], Float[Array, ""]]:
    """Update the camera, and the pose of one view, with one measurement.

    Args:
        camera: `[C m]`.
        pose: `[D G a]` of the view.
        measurement: `[H_e H_s -z]`, in units of the noise.

    Returns:
        Camera and pose after the measurement, the squared innovation relative to its covariance,
        and the sum of the variances that the state alone gives to the predicted u and v.
    """
    H_e = measurement[:, :POSE_SIZE]
    new_pose, product, S_e, _ = _subtract_explained(
        pose, H_e, measurement.at[:, :POSE_SIZE].set(0.0), jnp.eye(2)
    )
    # product = [H_e D, h, H_e a - z]
    # The measurement without what it tells about the pose is a measurement of the camera.
    h = product[:, POSE_SIZE:-1]
    new_camera, _, S, whitened = _subtract_explained(
        camera, h, product[:, POSE_SIZE:].at[:, :-1].set(0.0), S_e
    )
    return new_camera, new_pose, jnp.sum(whitened[:, -1] ** 2), jnp.trace(S) - 2.0


def _subtract_explained(
    B: Float[Array, "size columns"],
    H: Float[Array, "2 size"],
    R: Float[Array, "2 columns"],
    noise: Float[Array, "2 2"],
) -> tuple[Array, Array, Array, Array]:
    """Return B without what a measurement explains, `H B + R`, its covariance, and W."""
    size = len(B)
    # Products of so small matrices are sums here: XLA fuses these, and calls a routine for `@`.
    product = jnp.sum(H[:, :, None] * B[None], axis=1) + R
    S = jnp.sum(product[:, None, :size] * H[None], axis=-1) + noise
    # The Cholesky factor of 2 x 2 is written out: LAPACK is not worth its call here.
    L00 = jnp.sqrt(S[0, 0])
    L10 = S[1, 0] / L00
    L11 = jnp.sqrt(S[1, 1] - L10**2)
    first = product[0] / L00
    W = jnp.stack([first, (product[1] - L10 * first) / L11])
    return B - W[0, :size, None] * W[0][None] - W[1, :size, None] * W[1][None], product, S, W


def whole_mean_and_variances(state: FilterState) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and variance of the camera's parameters, then of every pose's parameters."""
    C, m = np.split(np.asarray(state.camera), [-1], axis=1)
    D, G, a = np.split(np.asarray(state.poses), [POSE_SIZE, -1], axis=2)
    pose_mean = a + G @ m
    pose_variances = np.diagonal(D, axis1=1, axis2=2) + np.sum(G @ C * G, axis=2)
    return (
        np.concatenate([m.ravel(), pose_mean.ravel()]),
        np.concatenate([np.diag(C), pose_variances.ravel()]),
    )


def whole_covariance(
    state: FilterState,
    camera_scale: Float[np.ndarray, "camera"],
    pose_maps: Float[np.ndarray, "views 6 6"],
) -> Float[np.ndarray, "state state"]:
    """Return the covariance of the camera's parameters, then of every pose's parameters.

    Args:
        state: distribution in scaled numbers.
        camera_scale: what the camera's numbers are multiplied with.
        pose_maps: what the numbers of each pose are multiplied with, from the left.
    """
    C = np.asarray(state.camera)[:, :-1]
    D, G, _ = np.split(np.asarray(state.poses), [POSE_SIZE, -1], axis=2)
    gains = (pose_maps @ G).reshape(-1, len(C))
    by_camera = np.concatenate([np.diag(camera_scale), gains])
    covariance = by_camera @ C @ by_camera.T
    rows = len(C) + np.arange(POSE_SIZE * len(D)).reshape(-1, POSE_SIZE)
    covariance[rows[:, :, None], rows[:, None]] += pose_maps @ D @ pose_maps.swapaxes(1, 2)
    return covariance
