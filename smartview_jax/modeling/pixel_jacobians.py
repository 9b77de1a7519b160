"""Differentiate the pixels of points by the points, the camera and the pose of each view."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..cameras import AnyCamera, ravelled_cameras
from ..runtime.array_namespace import to_device
from ..runtime.compilation import compiled
from ..runtime.padding import repeat_last
from .view_poses import SeenViews, padded_count, padded_to


class PixelJacobians(NamedTuple):
    """The pixels of points in all views, with their derivatives; zero where there is no pixel.

    Attributes:
        valid: whether a point can be projected.
        by_point: derivatives by the point in the world, px/m.
        by_view: derivatives by the parameters of the camera, or of all cameras, then by the twist
            of `camera_from_world` in the camera frame (translation, rotation).
    """

    pixels: Float[np.ndarray, "views points 2"]
    valid: Bool[np.ndarray, "views points"]
    by_point: Float[np.ndarray, "views points 2 3"]
    by_view: Float[np.ndarray, "views points 2 local"]


def pixel_jacobians(
    views: SeenViews,
    points: Float[np.ndarray, "points 3"],
    camera_from_world: Float[np.ndarray, "views 4 4"] | None = None,
) -> PixelJacobians:
    """Return the pixels of points in all views and their derivatives.

    Args:
        views: camera and poses.
        points: in the world, m.
        camera_from_world: poses to use instead of the views' own, such as corrected poses.
    """
    view_count, count = len(views.camera_from_world), len(points)
    poses = views.poses_for(count)
    if camera_from_world is not None:
        poses = repeat_last(camera_from_world, len(poses))
    # A padded point may lie behind a camera, where it is invalid; padding is cut off below.
    padded = padded_to(points, (padded_count(count),), 0.0)
    camera = views.camera_for(len(poses))
    arrays = _jacobians(camera, to_device(poses), to_device(padded))
    return PixelJacobians(*(np.asarray(array)[:view_count, :count] for array in arrays))


@compiled
def _jacobians(
    camera: AnyCamera,
    camera_from_world: Float[Array, "views 4 4"],
    points: Float[Array, "points 3"],
) -> tuple[
    Float[Array, "views points 2"],
    Bool[Array, "views points"],
    Float[Array, "views points 2 3"],
    Float[Array, "views points 2 local"],
]:
    """Return pixels, validity and the two Jacobians of `PixelJacobians`."""
    # p = R x + t
    rotation, translation = camera_from_world[:, :3, :3], camera_from_world[:, :3, 3]
    p = jnp.einsum("vij,pj->vpi", rotation, points) + translation[:, None]
    numbers, rebuild = ravelled_cameras(camera)
    pixels, valid = camera.project(p)

    def by_camera_frame(tangent: Float[Array, "3"]) -> Float[Array, "views points 2"]:
        return jax.jvp(lambda x: camera.project(x)[0], (p,), (jnp.broadcast_to(tangent, p.shape),))[
            1
        ]

    def by_camera(tangent: Float[Array, "numbers"]) -> Float[Array, "views points 2"]:
        return jax.jvp(lambda n: rebuild(n).project(p)[0], (numbers,), (tangent,))[1]

    # Forward derivatives: few inputs, many pixels.
    D = jnp.moveaxis(jax.vmap(by_camera_frame)(jnp.eye(3)), 0, -1)
    C = jnp.moveaxis(jax.vmap(by_camera)(jnp.eye(numbers.size)), 0, -1)
    # A twist (v, w) of the pose moves p by v + w x p, so that each row d of D becomes p x d.
    turned = jnp.cross(jnp.broadcast_to(p[:, :, None], D.shape), D)
    by_point = jnp.einsum("vpui,vij->vpuj", D, rotation)
    by_view = jnp.concatenate([C, D, turned], axis=-1)

    # Zero derivatives where there is no pixel leave sums unchanged.
    def zero_where_invalid(array: Array) -> Array:
        return jnp.where(valid.reshape(valid.shape + (1,) * (array.ndim - 2)), array, 0.0)

    return (
        zero_where_invalid(pixels),
        valid,
        zero_where_invalid(by_point),
        zero_where_invalid(by_view),
    )
