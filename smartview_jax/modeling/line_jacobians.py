"""Measure distances of segments from the pictures of lines in space, with their derivatives.

A straight line is straight in a picture only without distortion. So the distance is measured on
rays: a camera's centre and a line span a plane, and the ray of a pixel on the picture of the line
lies in it. The angle between ray and plane, over the angle that one pixel makes across the plane,
is the distance of the pixel from the line's picture to first order (Sampson distance).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..cameras import AnyCamera, camera_axes, ravelled_cameras
from ..runtime.array_namespace import to_device
from ..runtime.compilation import compiled
from ..runtime.padding import repeat_last
from .view_poses import SeenViews, padded_count, padded_to


class Lines(NamedTuple):
    """Straight lines in space, each by a point on it and its unit direction.

    Four numbers move a line: two shift the point and two turn the direction, along the two axes of
    `perpendicular`. The other movements of the point and direction do not move the line.

    Attributes:
        points: a point on each line, m.
        directions: unit directions.
    """

    points: Float[np.ndarray, "lines 3"]
    directions: Float[np.ndarray, "lines 3"]

    @property
    def perpendicular(self) -> Float[np.ndarray, "lines 3 2"]:
        """Two unit vectors perpendicular to each line and to each other."""
        return perpendicular_axes(self.directions)

    def moved(self, step: Float[np.ndarray, "lines 4"]) -> "Lines":
        """Return the lines after a step: two shifts (m) and two turns (rad) each."""
        # A turn about the point, so that shift and turn do not mix.
        shift, turn = (
            np.einsum("lij,lj->li", self.perpendicular, step[:, k : k + 2]) for k in (0, 2)
        )
        directions = self.directions + turn
        length = np.linalg.norm(directions, axis=1, keepdims=True)
        return Lines(self.points + shift, directions / length)


def perpendicular_axes(
    directions: Float[np.ndarray, "vectors 3"],
) -> Float[np.ndarray, "vectors 3 2"]:
    """Return two unit vectors perpendicular to each unit vector, and to each other."""
    # The coordinate axis farthest from the direction gives a well-conditioned product.
    farthest = np.eye(3)[np.argmin(np.abs(directions), axis=1)]
    first = np.cross(directions, farthest)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(directions, first)], axis=-1)


class LineJacobians(NamedTuple):
    """The distances of segments' ends from the pictures of lines, with their derivatives.

    All values are zero where a segment is not visible.

    Attributes:
        distances: signed distance of both ends from the line's picture, px.
        sigmas: standard deviations of these distances, px.
        by_line: derivatives by the line's four numbers.
        by_view: derivatives by the camera's parameters, then by the twist of `camera_from_world`
            in the camera frame.
    """

    distances: Float[np.ndarray, "views lines 2"]
    sigmas: Float[np.ndarray, "views lines 2"]
    by_line: Float[np.ndarray, "views lines 2 4"]
    by_view: Float[np.ndarray, "views lines 2 local"]

    @property
    def weights(self) -> Float[np.ndarray, "views lines 2"]:
        """The inverse standard deviations; 1 where a segment is not visible."""
        return 1.0 / np.where(self.sigmas > 0.0, self.sigmas, 1.0)


def line_jacobians(
    views: SeenViews,
    lines: Lines,
    segments: Float[np.ndarray, "views lines 2 2"],
    covariances: Float[np.ndarray, "views lines 2 2 2"],
    visible: Bool[np.ndarray, "views lines"],
    camera_from_world: Float[np.ndarray, "views 4 4"] | None = None,
) -> LineJacobians:
    """Return the distances of segments from lines and their derivatives.

    Args:
        segments: both ends of each line's segment in each view, px.
        covariances: covariance of each end, px^2.
        visible: where a line has a segment.
        camera_from_world: poses to use instead of the views' own, such as corrected poses.
    """
    view_count, count = visible.shape
    if not count:
        local = ravelled_cameras(views.camera)[0].size + 6
        ends = np.zeros((view_count, 0, 2))
        return LineJacobians(ends, ends, np.zeros((*ends.shape, 4)), np.zeros((*ends.shape, local)))
    poses = views.padded
    if camera_from_world is not None:
        poses = repeat_last(camera_from_world, len(poses))
    shape = (len(poses), padded_count(count))
    # Padding is a line and a pixel that work with any camera, and are not visible.
    filler = views.centres[0] + views.camera_from_world[0, 2, :3]
    numbers = np.concatenate(
        [lines.points, lines.directions, lines.perpendicular.reshape(count, 6)], axis=1
    )
    padding = np.concatenate([filler, np.eye(3)[0], np.eye(3)[:, 1:].ravel()])
    rows = np.tile(padding, (shape[1] - count, 1))
    # Ends that are not visible may be NaN; the top-left pixel is within every lens.
    safe = np.where(visible[..., None, None], segments, 0.0)
    arrays = _jacobians(
        views.camera_for(len(poses)),
        to_device(poses),
        to_device(np.concatenate([numbers, rows])),
        to_device(padded_to(safe, shape)),
        to_device(padded_to(covariances, shape)),
        to_device(padded_to(visible, shape, False)),
    )
    return LineJacobians(*(np.asarray(array)[:view_count, :count] for array in arrays))


@compiled
def _jacobians(
    camera: AnyCamera,
    camera_from_world: Float[Array, "views 4 4"],
    lines: Float[Array, "lines 12"],
    segments: Float[Array, "views lines 2 2"],
    covariances: Float[Array, "views lines 2 2 2"],
    visible: Bool[Array, "views lines"],
) -> tuple[
    Float[Array, "views lines 2"],
    Float[Array, "views lines 2"],
    Float[Array, "views lines 2 4"],
    Float[Array, "views lines 2 local"],
]:
    count = ravelled_cameras(camera)[0].size

    def of_end(
        view_camera: AnyCamera,
        pose: Array,
        line: Array,
        pixel: Array,
        covariance: Array,
        used: Array,
    ) -> tuple:
        numbers, rebuild = ravelled_cameras(view_camera)

        def angle(step: Array, z: Array) -> Array:
            """Return the sine of the angle between a pixel's ray and the line's plane."""
            point, direction = line[:3], line[3:6]
            axes = line[6:].reshape(3, 2)
            ray, valid = rebuild(numbers + step[4 : 4 + count]).unproject(z)
            moved_point = point + axes @ step[:2]
            moved_direction = direction + axes @ step[2:4]
            twist = step[4 + count :]
            p = pose[:3, :3] @ moved_point + pose[:3, 3]
            d = pose[:3, :3] @ moved_direction
            # To first order a twist (v, w) moves p by v + w x p and turns d by w x d.
            p, d = p + twist[:3] + jnp.cross(twist[3:], p), d + jnp.cross(twist[3:], d)
            # p x d is normal to the plane through the camera's centre and the line.
            normal = jnp.cross(p, d)
            return jnp.where(valid, normal @ ray / jnp.linalg.norm(normal), 0.0)

        zero = jnp.zeros(4 + count + 6)
        # The scale is held constant: its derivative is multiplied by the residual, which is small.
        value, by_step = jax.value_and_grad(angle)(zero, pixel)
        by_pixel = jax.grad(angle, argnums=1)(zero, pixel)
        per_pixel = jnp.linalg.norm(by_pixel)
        usable = used & (per_pixel > 0.0)
        scale = jnp.where(usable, 1.0 / jnp.where(per_pixel > 0.0, per_pixel, 1.0), 0.0)
        # The variance of the angle is g^T C g, with g its derivative by the pixel.
        sigma = jnp.sqrt(by_pixel @ covariance @ by_pixel) * scale
        return value * scale, sigma, by_step[:4] * scale, by_step[4:] * scale

    # Both ends of a segment share its line and view; all lines share the view's pose.
    ends = jax.vmap(of_end, (None, None, None, 0, 0, None))
    over_lines = jax.vmap(ends, (None, None, 0, 0, 0, 0))
    over_views = jax.vmap(over_lines, (camera_axes(camera), 0, None, 0, 0, 0))
    return over_views(camera, camera_from_world, lines, segments, covariances, visible)
