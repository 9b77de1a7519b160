"""The paper's comparison: extrinsics of a new viewpoint by linear interpolation.

    e(command) = sum_k w_k e^k

over the calibrated viewpoints, `w` being the least-norm weights of sum 1 that reproduce the
commanded position. `e` is yaw, pitch, roll and the translation of `camera_from_world`: averaging
angles is what this method does, and a reason why it is the worst of Table 1.

Viewpoints about one object at one distance nearly lie in a plane. Weights that reproduced the small
part of a position across it would be huge, of either sign, and made of noise; so positions are
reproduced in the plane alone, or along the line, that the viewpoints span.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Bool, Float
from scipy.optimize import nnls

from ..cameras import Camera
from ..geometry import transform_points
from ..robots import CommandLike, as_command

FLAT = 0.1
"""Spread of the viewpoints across a direction, over their widest, under which they do not span it.
Viewpoints within 19 degrees about an object have 0.07 at most across their plane, views that roam
over distances and angles 0.1 to 0.4."""

ON_THE_HULL = 0.01
"""Share of the farthest viewpoint's distance from the middle by which a position may lie outside
the hull and still count as on it: robots err."""

_SUM_TO_ONE = 10.0
"""Weight of the weights' sum beside positions of about 1, so that the sum gives way the least."""


class Interpolation(eqx.Module):
    """Calibrated viewpoints, and what lies between them.

    Attributes:
        camera: intrinsics common to all viewpoints (Step 2).
        positions: where the tool was at each, in the base frame, m.
        extrinsics: yaw, pitch, roll (rad, unwrapped) and translation (m) of each.
        axes: unit vectors in the base frame that the positions span, `(dimensions, 3)`: three,
            two for a plane, one for a line, none for a single place.
        gains: the weights as linear functions of `(1, x, y, z)`, the position in the base frame.
    """

    camera: Camera
    positions: Float[Array, "views 3"]
    extrinsics: Float[Array, "views 6"]
    axes: Float[Array, "dimensions 3"]
    gains: Float[Array, "views 4"]

    def __init__(self, camera: Camera, base_from_tool: SE3, camera_from_world: SE3):
        angles = jnp.stack(camera_from_world.rotation().as_rpy_radians()[::-1], axis=-1)
        turns = jnp.round((angles - angles[:1]) / (2.0 * jnp.pi))
        self.camera = camera
        self.positions = base_from_tool.translation()
        self.extrinsics = jnp.concatenate(
            [angles - 2.0 * jnp.pi * turns, camera_from_world.translation()], axis=1
        )
        placed = np.asarray(self.positions)
        middle = placed.mean(axis=0)
        U, spread, Vt = np.linalg.svd(placed - middle, full_matrices=False)
        spanned = spread > FLAT * max(spread[0], np.finfo(float).tiny)
        slopes = (U[:, spanned] / spread[spanned]) @ Vt[spanned]
        self.axes = jnp.asarray(Vt[spanned])
        self.gains = jnp.asarray(np.column_stack([1.0 / len(placed) - slopes @ middle, slopes]))

    def weights(self, position: Float[Array, "*batch 3"]) -> Float[Array, "*batch views"]:
        """Return least-norm weights with sum 1 that reproduce positions as far as they can.

        What of a position, m, lies across the plane or line of the viewpoints is left out.
        """
        one = jnp.ones_like(position[..., :1])
        return jnp.concatenate([one, position], axis=-1) @ self.gains.T

    def inside(self, base_from_tool: CommandLike) -> Bool[np.ndarray, "*views"]:
        """Return whether robot poses lie between the viewpoints; others are extrapolated.

        Between means within the hull of the viewpoints' positions along what they span, and no
        farther across it than the farthest of them, or than `FLAT` times their reach.
        """
        positions = np.asarray(as_command(base_from_tool).base_from_tool.translation())
        corners, axes = np.asarray(self.positions), np.asarray(self.axes)
        middle = corners.mean(axis=0)
        size = max(np.linalg.norm(corners - middle, axis=1).max(), np.finfo(float).tiny)
        corners, places = (corners - middle) / size, (positions.reshape(-1, 3) - middle) / size
        # In the hull is what weights of sum 1 reproduce without one of them being negative.
        A = np.vstack([np.full(len(corners), _SUM_TO_ONE), axes @ corners.T])
        gaps = np.array([nnls(A, np.r_[_SUM_TO_ONE, axes @ place])[1] for place in places])
        thickness = max(_distance_across(corners, axes).max(), FLAT)
        near = _distance_across(places, axes) <= thickness + ON_THE_HULL
        return (near & (gaps <= ON_THE_HULL)).reshape(positions.shape[:-1])

    def camera_from_world(self, base_from_tool: CommandLike) -> SE3:
        """Extrinsics at the given robot poses, `(*views)`."""
        e = self.weights(as_command(base_from_tool).base_from_tool.translation()) @ self.extrinsics
        rotation = SO3.from_rpy_radians(e[..., 2], e[..., 1], e[..., 0])
        return SE3.from_rotation_and_translation(rotation, e[..., 3:])

    def points_in_camera(
        self, base_from_tool: CommandLike, points: Float[Array, "*points 3"]
    ) -> Float[Array, "*moved 3"]:
        """Target points in the camera frame, m."""
        return transform_points(self.camera_from_world(base_from_tool), jnp.asarray(points, float))

    def project(
        self, base_from_tool: CommandLike, points: Float[Array, "*points 3"]
    ) -> tuple[Float[Array, "*pixels 2"], Bool[Array, "*pixels"]]:
        """Pixels of target points, shapes as in `Calibration.project`."""
        return self.camera.project(self.points_in_camera(base_from_tool, points))


def _distance_across(
    places: Float[np.ndarray, "places 3"], axes: Float[np.ndarray, "dimensions 3"]
) -> Float[np.ndarray, "places"]:
    """Return how far places are from what the axes through the middle span, in their own unit."""
    return np.linalg.norm(places - places @ axes.T @ axes, axis=1)
