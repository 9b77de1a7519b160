"""Add the depths of the points in pictures to the normal equations of a joint fit.

A depth z of a point at p in the camera's frame is measured as (p_z - offset) / scale. It depends on
the view's pose and on the sensor's two parameters, not on the lens, so that depths add a small
matrix to each view after the pixels' one is formed (`view_normal_equations.py`), and nothing where
there are none. A change of the target's scale moves points along their rays as well, which pixels
do not show, but depths do.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..calibration import Calibration, TargetShape
from ..dataset import DepthReadings, Observations
from ..geometry import transformed_coordinates
from .abstract_problem import NormalEquations, ViewBlocks
from .parameters import Step
from .schur import BlockArrow

VIEWS_AT_ONCE = 8
"""Number of views that are linearised together, so that memory does not grow with all points."""


class DepthEquations(eqx.Module):
    """The terms of the normal equations that the depths of every view add.

    The rows of `by_parameters` are scale and offset of the sensor, the logarithm of the target's
    scale at a given pose, the coefficients of the target's shape if it is a parameter, and the
    twist of the view's pose, as in `ViewNormalEquations`.

    Attributes:
        matrix: sum of `J^T J` over the depths of a view, whitened, by these rows.
        gradient: gradient of the cost by these rows.
        cost: half the sum of squared whitened residuals.
        by_parameters: derivative of the rows by the shared parameters, in their units.
        per_view: derivative of the twist by the view's own parameters, in their units.
    """

    matrix: Float[Array, "views rows rows"]
    gradient: Float[Array, "views rows"]
    cost: Float[Array, "views"]
    by_parameters: Float[Array, "views rows columns"]
    per_view: Float[Array, "corrected 6 6"]

    @property
    def shared_gradients(self) -> Float[Array, "views columns"]:
        """The gradient by the shared parameters of each view."""
        return jnp.einsum("vri,vr->vi", self.by_parameters, self.gradient)

    @property
    def blocks(self) -> ViewBlocks:
        """The terms of each view."""
        products = self.matrix @ self.by_parameters
        transposed, corrected = jnp.swapaxes(self.per_view, 1, 2), len(self.per_view)
        return ViewBlocks(
            jnp.swapaxes(self.by_parameters, 1, 2) @ products,
            transposed @ products[:corrected, -6:],
            transposed @ self.matrix[:corrected, -6:, -6:] @ self.per_view,
        )

    def added_to(self, equations: NormalEquations) -> NormalEquations:
        """Return normal equations of pixels with the terms of the depths."""
        blocks, gradient, matrix = self.blocks, equations.gradient, equations.matrix
        corrected = len(self.per_view)
        by_depth = jnp.einsum("vki,vk->vi", self.per_view, self.gradient[:corrected, -6:])
        return NormalEquations(
            equations.cost + jnp.sum(self.cost),
            Step(
                gradient.shared + jnp.sum(self.shared_gradients, axis=0),
                gradient.per_view + by_depth,
            ),
            BlockArrow(
                matrix.shared + jnp.sum(blocks.shared, axis=0),
                matrix.border + blocks.border,
                matrix.per_view + blocks.per_view,
            ),
        )


def depth_residuals(
    calibration: Calibration,
    camera_from_world: Float[Array, "*views 4 4"],
    observations: Observations,
    pixel_sigma: Float[Array, ""],
) -> Float[Array, "views points"]:
    """Return measured minus predicted depths, whitened, zero where there is none.

    Args:
        calibration: with target scale and bias of the depths.
        camera_from_world: pose of the world in each view's camera, as a matrix.
        observations: points and depths.
        pixel_sigma: standard deviation of u and of v, px.
    """
    return _linearised(calibration, camera_from_world, observations, pixel_sigma, None)[0]


def linearise_depths(
    calibration: Calibration,
    camera_from_world: Float[Array, "*views 4 4"],
    observations: Observations,
    pixel_sigma: Float[Array, ""],
    shape: TargetShape | None,
) -> tuple[Float[Array, "views rows rows"], Float[Array, "views rows"], Float[Array, "views"]]:
    """Return matrix, gradient and cost of `DepthEquations`.

    Args:
        calibration, camera_from_world, observations, pixel_sigma: as in `depth_residuals`.
        shape: shape of the target, if its coefficients are parameters.
    """

    def one_view(view: tuple[Array, Observations]) -> tuple[Array, Array, Array]:
        """Return the equations of one view."""
        pose, seen = view
        residuals, columns = _linearised(calibration, pose, seen, pixel_sigma, shape)
        # The columns are of the prediction: the residual's derivatives have the opposite sign.
        return columns.T @ columns, -columns.T @ residuals, 0.5 * jnp.sum(residuals**2)

    return jax.lax.map(one_view, (camera_from_world, observations), batch_size=VIEWS_AT_ONCE)


def _linearised(
    calibration: Calibration,
    camera_from_world: Float[Array, "*views 4 4"],
    observations: Observations,
    pixel_sigma: Float[Array, ""],
    shape: TargetShape | None,
) -> tuple[Float[Array, "*views points"], Float[Array, "*views points rows"]]:
    """Return whitened residuals, and the derivatives of the whitened predictions."""
    depths, bias = observations.depths, calibration.depth_bias
    assert depths is not None
    assert bias is not None
    points, scale = observations.points, calibration.target_scale
    rotation = scale * camera_from_world[..., :3, :3]
    x, y, z = transformed_coordinates(rotation, camera_from_world[..., :3, 3], points)
    predicted = bias.measured(z)
    # Depths count by `precision` where pixels are as noisy as it was meant for.
    weight = depths.pixel_sigma[..., None] / pixel_sigma * depths.precision
    weight = jnp.where(observations.visible, weight, 0.0)
    zero, one = jnp.zeros_like(z), jnp.ones_like(z)
    bent = () if shape is None else jnp.moveaxis(shape.directions(points), -2, 0)
    # p = scale R X + t: at a given pose d p_z / d log(scale) = p_z, since the column of the pose
    # has -t_z already (`pose_jacobians.py`). The twist (v, w) moves p_z by v_z + w_x y - w_y x.
    by_depth = [
        z,
        *((rotation[..., 2, None, :] * direction).sum(axis=-1) for direction in bent),
        *(zero, zero, one, y, -x, zero),
    ]
    columns = jnp.stack([-predicted, -one, *by_depth], axis=-1) / bias.scale
    residuals = weight * (depths.measured - predicted)
    direction, shrink = _common_error(depths, observations.visible)

    def whitened(values: Array) -> Array:
        """Return numbers by depth, `(..., points, numbers)`, less by their common error."""
        return values - shrink * direction * jnp.sum(direction * values, axis=-2, keepdims=True)

    return whitened(residuals[..., None])[..., 0], whitened(weight[..., None] * columns)


def _common_error(
    depths: DepthReadings, visible: Bool[Array, "*views points"]
) -> tuple[Float[Array, "*views points 1"], Float[Array, "*views 1 1"]]:
    """Return the direction of the error that depths of a view have in common, and its shrinkage.

    Depths with precisions u (inverse standard deviations) and a common error of variance t have,
    after division by their own standard deviations, the covariance 1 + t u u^T. Its inverse root is
    1 - (1 - 1 / sqrt(1 + t |u|^2)) e e^T with e = u / |u|.
    """
    precision = jnp.where(visible, depths.precision, 0.0)
    square = jnp.sum(precision**2, axis=-1)
    some = jnp.where(square > 0.0, square, 1.0)
    shrink = 1.0 - 1.0 / jnp.sqrt(1.0 + depths.common_std**2 * square)
    direction = precision / jnp.sqrt(some)[..., None]
    return direction[..., None], shrink[..., None, None]
