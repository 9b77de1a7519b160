"""Interpolate the extrinsics of a new viewpoint linearly, the paper's comparison method.

    e(command) = sum_k w_k e^k

is a sum over the calibrated viewpoints, where w are the minimum-norm weights of sum 1 that
reproduce the commanded position. `e` is yaw, pitch, roll (Eq. 16) and the translation of
`camera_from_world`. The method averages angles, which is one reason why it has the largest error
in the paper's Table 1.

Viewpoints around one object at one distance lie nearly in a plane. Weights that reproduce the small
component of a position normal to that plane would be very large, of both signs, and determined by
noise. Positions are therefore reproduced only within the plane (or line) that the viewpoints span.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Bool, Float
from scipy.optimize import nnls

from ..cameras import Camera
from ..geometry import transform_points, ypr_from_rotation
from ..robots import CommandLike, as_command
from ..runtime.array_namespace import to_device
from ..runtime.compilation import one_program

MIN_SPREAD_RATIO = 0.1
"""Ratio of the spread of the viewpoints along a direction to their largest spread, below which they
do not span that direction.

Viewpoints within 19 degrees around an object have at most 0.07 normal to their plane, views at
various distances and angles 0.1 to 0.4."""

HULL_TOLERANCE = 0.01
"""Distance by which a position may lie outside the convex hull and still count as inside, as a
fraction of the farthest viewpoint's distance from the centroid. It allows for robot error."""

_SUM_TO_ONE_WEIGHT = 10.0
"""Row weight of the sum-to-one condition; position rows have a size of about 1."""


class Interpolation(eqx.Module):
    """A predictor of extrinsics and pixels by interpolation between calibrated viewpoints.

    Attributes:
        camera: intrinsics common to all viewpoints (Step 2).
        positions: tool position at each viewpoint, in the base frame, m.
        extrinsics: yaw, pitch, roll (rad, unwrapped) and translation (m) of each.
        spanned_axes: unit vectors in the base frame that the positions span, `(dimensions, 3)`:
            three, two for a plane, one for a line, none for a single point.
        weight_coefficients: the weights as linear functions of `(1, x, y, z)`, the position in the
            base frame.
    """

    camera: Camera
    positions: Float[Array, "views 3"]
    extrinsics: Float[Array, "views 6"]
    spanned_axes: Float[Array, "dimensions 3"]
    weight_coefficients: Float[Array, "views 4"]

    def __init__(self, camera: Camera, base_from_tool: SE3, camera_from_world: SE3):
        """Compute the coefficients of the weights from robot and camera poses of the viewpoints."""
        numbers = np.asarray(camera_from_world.wxyz_xyz)
        angles = np.asarray(ypr_from_rotation(SO3(to_device(numbers[:, :4]))))
        # Unwrap the angles: 179 and -179 degrees must not average to 0.
        revolutions = np.round((angles - angles[:1]) / (2.0 * np.pi))
        self.camera = camera
        self.extrinsics = to_device(
            np.concatenate([angles - 2.0 * np.pi * revolutions, numbers[:, 4:]], axis=1)
        )
        positions = np.asarray(base_from_tool.wxyz_xyz)[:, 4:]
        self.positions = to_device(positions)
        centroid = positions.mean(axis=0)
        U, singular_values, Vt = np.linalg.svd(positions - centroid, full_matrices=False)
        # Minimum-norm weights: w = 1/n + gradient (position - centroid), where the gradient is the
        # pseudoinverse of the centred positions' transpose, restricted to the directions that the
        # viewpoints span.
        spanned = singular_values > MIN_SPREAD_RATIO * max(singular_values[0], np.finfo(float).tiny)
        gradient = (U[:, spanned] / singular_values[spanned]) @ Vt[spanned]
        self.spanned_axes = to_device(Vt[spanned])
        self.weight_coefficients = to_device(
            np.column_stack([1.0 / len(positions) - gradient @ centroid, gradient])
        )

    @one_program
    def weights(self, position: Float[Array, "*batch 3"]) -> Float[Array, "*batch views"]:
        """Return minimum-norm weights of sum 1 that reproduce the given positions.

        The component of a position (m) normal to the viewpoints' plane or line is ignored.
        """
        ones = jnp.ones_like(position[..., :1])
        return jnp.concatenate([ones, position], axis=-1) @ self.weight_coefficients.T

    def is_inside(self, base_from_tool: CommandLike) -> Bool[np.ndarray, "*views"]:
        """Return whether robot poses lie between the viewpoints, so that none is extrapolated.

        A position must be within the convex hull of the viewpoints along the directions they span,
        and no farther from their plane or line than the farthest viewpoint, or than
        `MIN_SPREAD_RATIO` times the distance of the farthest viewpoint from the centroid.
        """
        positions = np.asarray(as_command(base_from_tool).base_from_tool.translation())
        viewpoints, axes = np.asarray(self.positions), np.asarray(self.spanned_axes)
        centroid = viewpoints.mean(axis=0)
        radius = max(np.linalg.norm(viewpoints - centroid, axis=1).max(), np.finfo(float).tiny)
        viewpoints = (viewpoints - centroid) / radius
        queries = (positions.reshape(-1, 3) - centroid) / radius
        # A point is in the convex hull if non-negative weights of sum 1 reproduce it. The residual
        # of non-negative least squares is then zero.
        A = np.vstack([np.full(len(viewpoints), _SUM_TO_ONE_WEIGHT), axes @ viewpoints.T])
        hull_residuals = np.array(
            [nnls(A, np.r_[_SUM_TO_ONE_WEIGHT, axes @ query])[1] for query in queries]
        )
        thickness = max(_distance_from_subspace(viewpoints, axes).max(), MIN_SPREAD_RATIO)
        near_subspace = _distance_from_subspace(queries, axes) <= thickness + HULL_TOLERANCE
        return (near_subspace & (hull_residuals <= HULL_TOLERANCE)).reshape(positions.shape[:-1])

    def camera_from_world(self, base_from_tool: CommandLike) -> SE3:
        """Return the interpolated extrinsics at the given robot poses, `(*views)`."""
        e = self.weights(as_command(base_from_tool).base_from_tool.translation()) @ self.extrinsics
        rotation = SO3.from_rpy_radians(e[..., 2], e[..., 1], e[..., 0])
        return SE3.from_rotation_and_translation(rotation, e[..., 3:])

    def points_in_camera(
        self, base_from_tool: CommandLike, points: Float[Array, "*points 3"]
    ) -> Float[Array, "*transformed 3"]:
        """Return target points in the camera frame, m."""
        return transform_points(self.camera_from_world(base_from_tool), jnp.asarray(points, float))

    def project(
        self, base_from_tool: CommandLike, points: Float[Array, "*points 3"]
    ) -> tuple[Float[Array, "*pixels 2"], Bool[Array, "*pixels"]]:
        """Return pixels of target points and their validity, shapes as in `Calibration.project`."""
        return self.camera.project(self.points_in_camera(base_from_tool, points))


def _distance_from_subspace(
    points: Float[np.ndarray, "points 3"], axes: Float[np.ndarray, "dimensions 3"]
) -> Float[np.ndarray, "points"]:
    """Return the distance of points from the subspace spanned by the axes, in the points' unit."""
    # What remains of a point after its projection onto the orthonormal axes is subtracted.
    return np.linalg.norm(points - points @ axes.T @ axes, axis=1)
