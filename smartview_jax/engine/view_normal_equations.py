"""Linearise all observations into one small matrix of normal equations per view.

Every parameter except the camera's acts on the pixels of a view only through the pose of that view,
and a change of a pose is a twist. So the Jacobian of a point always has columns for the camera's
parameters and six columns for a twist in the camera frame, whatever is fitted; this file does not
depend on the robot. The products of these columns are formed chunk by chunk, so that memory does
not grow with the number of points. `pose_jacobians.py` continues from twists to parameters.

The columns of u and of v are separate, because v does not depend on alpha_u and u0, nor u on
alpha_v and v0.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..calibration import TargetShape
from ..cameras import AbstractLens, AbstractPerspectiveLens, Camera
from ..dataset import Observations
from ..geometry import transformed_coordinates
from .losses import AbstractLoss

INVALID_PROJECTION_RESIDUAL = 1e3
"""Whitened residual, in pixel sigmas, of u and of v of a visible point that cannot be projected.

It is so large that moving points out of the lens's domain never lowers the cost.
"""

MAX_CHUNK_POINTS = 4096
"""Largest number of points of a view in a chunk; their columns fit the CPU's cache."""

MAX_GROUP_POINTS, MAX_GROUP_CHUNKS = 1024, 8
"""Largest number of points, and of chunks, linearised in one iteration.

Chunks with few points are grouped, because every iteration of a compiled loop costs some 10 us.
"""


class ViewNormalEquations(eqx.Module):
    """The normal equations of every view in the camera's parameters and a twist of its pose.

    The columns are the camera's parameters in the order of its leaves, the coefficients of the
    target's shape if it is a parameter, and the twist `(v, w)` of
    `camera_from_world -> exp((v, w)) @ camera_from_world`.

    Attributes:
        matrix: sum of `J^T J` over the points of a view, whitened.
        gradient: gradient of the cost.
        cost: half the sum of squared whitened residuals, or of the loss.
    """

    matrix: Float[Array, "views columns columns"]
    gradient: Float[Array, "views columns"]
    cost: Float[Array, "views"]

    def by_aspect(
        self,
        alpha_u: Float[Array, ""],
        alpha_v: Float[Array, ""],
        fits_aspect: Bool[Array, ""],
    ) -> "ViewNormalEquations":
        """Return the equations with the ratio of the focal lengths as a parameter.

        Args:
            alpha_u, alpha_v: the focal lengths.
            fits_aspect: whether the ratio is fitted in the place of alpha_v; else nothing changes.
        """
        # alpha_v = a alpha_u with the ratio a: alpha_u's column J_u becomes J_u + a J_v, and the
        # column of the ratio is alpha_u J_v, with J_v alpha_v's. The rows follow in the same way.
        ones = jnp.ones(self.gradient.shape[1])
        factors = ones.at[1].set(jnp.where(fits_aspect, alpha_u, 1.0))
        shares_of_v = (0.0 * ones).at[0].set(jnp.where(fits_aspect, alpha_v / alpha_u, 0.0))

        def by_columns(x: Float[Array, "*rows columns"]) -> Float[Array, "*rows columns"]:
            """Return an array by the columns of the Jacobian."""
            # All fits have this program. To set two columns, instead, took several times as long.
            leading = tuple(range(x.ndim - 1))
            share_of_v = jnp.expand_dims(shares_of_v, leading) * x[..., 1:2]
            return jnp.expand_dims(factors, leading) * x + share_of_v

        by_rows = jnp.swapaxes(by_columns(self.matrix), 1, 2)
        return ViewNormalEquations(by_columns(by_rows), by_columns(self.gradient), self.cost)


def linearise_views(
    camera: Camera,
    camera_from_world: Float[Array, "views 4 4"],
    observations: Observations,
    target_scale: Float[Array, ""],
    pixel_sigma: Float[Array, ""],
    loss: AbstractLoss | None,
    shape: TargetShape | None = None,
) -> ViewNormalEquations:
    """Compute the normal equations of every view from all its observations.

    Args:
        camera: camera with any central lens (pixels depend only on a point's direction).
        camera_from_world: pose of the world in each view's camera, as a matrix.
        observations: observations of shape `(views, points)`; points that are not visible do not
            count.
        target_scale: factor by which the points are multiplied.
        pixel_sigma: standard deviation of u and of v, px.
        loss: robust loss, whose weights give the normal equations of iteratively reweighted least
            squares; None is least squares.
        shape: shape of the target; the pixels are differentiated by its coefficients too.
    """
    views = len(observations.visible)
    # A chunk is a piece of one view; a group is several chunks, linearised in one iteration of the
    # loop below.
    points, pixels, visible = _split_into_chunks(observations)
    total_chunks, count = visible.shape
    chunks = total_chunks // views
    group = min(total_chunks, MAX_GROUP_CHUNKS, max(1, MAX_GROUP_POINTS // count))

    def linearise_group(group_arrays: tuple) -> tuple[Array, Array, Array]:
        """Linearise one group of chunks."""
        rotation, translation, points, pixels, visible = group_arrays
        # p = scale R X + t, with X the point on the target and p the point in the camera frame.
        in_camera = transformed_coordinates(target_scale * rotation, translation, points)
        displacements = ()
        if shape is not None:
            directions = jnp.moveaxis(shape.directions(points), -2, 0)
            displacements = tuple(
                transformed_coordinates(
                    target_scale * rotation, jnp.zeros_like(translation), direction
                )
                for direction in directions
            )
        columns_u, columns_v, cost = _jacobian_columns(
            camera,
            in_camera,
            jnp.moveaxis(pixels, -1, 0),
            visible,
            pixel_sigma,
            loss,
            displacements,
        )
        return _gram_matrices(columns_u), _gram_matrices(columns_v), cost.sum(axis=1)

    def group_chunks(x: Array) -> Array:
        """Arrange an array of chunks in groups, padded with zeros (invisible points) at the end."""
        padded = jnp.pad(x, ((0, -total_chunks % group), *((0, 0),) * (x.ndim - 1)))
        return padded.reshape(-1, group, *x.shape[1:])

    rotations = jnp.repeat(camera_from_world[:, :3, :3], chunks, axis=0)
    translations = jnp.repeat(camera_from_world[:, :3, 3], chunks, axis=0)
    groups = tuple(group_chunks(x) for x in (rotations, translations, points, pixels, visible))
    # Back from groups to chunks, without the padding; the matrix of a view is the sum over its
    # chunks.
    gram_u, gram_v, cost = (
        x.reshape(-1, *x.shape[2:])[:total_chunks].reshape(views, chunks, *x.shape[2:]).sum(axis=1)
        for x in jax.lax.map(linearise_group, groups)
    )
    return _assemble(gram_u, gram_v, cost)


def _gram_matrices(columns: Float[Array, "group rows points"]) -> Float[Array, "group rows rows"]:
    """Compute `columns @ columns.T` separately for each chunk of points."""
    # One batched product, because for small matrices a call takes longer than the product.
    return jnp.einsum("crn,csn->crs", columns, columns)


def _split_into_chunks(observations: Observations) -> tuple[Array, Array, Array]:
    """Split points, pixels and visibility into chunks, `(views * chunks, points, ...)`.

    The last chunk of a view is padded with invisible points if the points do not divide evenly.
    """
    views, count = observations.visible.shape
    min_chunks = max(1, -(-count // MAX_CHUNK_POINTS))
    # A number of chunks that divides the points evenly is preferred, because padding copies all
    # observations.
    chunks = next((k for k in range(min_chunks, 2 * min_chunks) if count % k == 0), min_chunks)
    padding = chunks * -(-count // chunks) - count

    def split(x: Array) -> Array:
        """Split one array into chunks."""
        padded = jnp.pad(x, ((0, 0), (0, padding), *((0, 0),) * (x.ndim - 2))) if padding else x
        return padded.reshape(views * chunks, -1, *x.shape[2:])

    return split(observations.points), split(observations.pixels), split(observations.visible)


def _jacobian_columns(
    camera: Camera,
    in_camera: tuple[Array, Array, Array],
    pixels: Float[Array, "2 group points"],
    visible: Bool[Array, "group points"],
    pixel_sigma: Float[Array, ""],
    loss: AbstractLoss | None,
    displacements: tuple[tuple[Array, Array, Array], ...],
) -> tuple[
    Float[Array, "group rows points"],
    Float[Array, "group rows points"],
    Float[Array, "group points"],
]:
    """Compute the Jacobian columns of u and of v, and the cost of each point.

    The rows of both results are: alpha, centre, lens parameters, displacements of the points in the
    camera frame, twist, residual.

    A visible point that cannot be projected has zero columns and the cost of
    `INVALID_PROJECTION_RESIDUAL`.
    """
    # u = alpha_u x + u0 and v = alpha_v y + v0, with (x, y) the distorted point on the unit plane;
    # r = (measured - predicted) / sigma.
    projected = _project_with_jacobians(camera.lens, in_camera, visible)
    (x, y), valid = projected.distorted, projected.valid
    predicted = (camera.alpha_u * x + camera.u0, camera.alpha_v * y + camera.v0)
    residual = [jnp.where(valid, pixels[k] - predicted[k], 0.0) / pixel_sigma for k in range(2)]
    square = residual[0] ** 2 + residual[1] ** 2
    cost, weight = _cost_and_weight(square, valid, visible & ~valid, loss)
    # Columns and residual are multiplied by sqrt(weight), so that their products are weighted once.
    # XLA recomputes common subexpressions of several columns for each of them, unless it considers
    # them expensive, such as square roots and divisions. Hence the divisions by sigma: derivatives
    # are whitened before they enter the columns.
    sqrt_weight = jnp.sqrt(jnp.where(valid, weight, 0.0))
    whitening = sqrt_weight / pixel_sigma
    px, py, pz = projected.ray
    columns = []
    for k, (normalised, alpha) in enumerate(((x, camera.alpha_u), (y, camera.alpha_v))):
        derivatives = [alpha * sqrt_weight * d[k] / pixel_sigma for d in projected.by_ray]
        if len(derivatives) == 2:
            # Only the direction of the ray matters: the derivative along the ray is zero, and pz is
            # 1.
            derivatives.append(-(px * derivatives[0] + py * derivatives[1]))
        hx, hy, hz = derivatives
        # Pose Jacobian: the twist (v, w) moves a point by dp = v + w x p. With g = du/dp the chain
        # rule gives du = g . v + g . (w x p) = g . v + (p x g) . w, so the six columns are
        # (g, p x g). With the ray q = p / d, whose derivative is h = du/dq, g = h / d and
        # p x g = q x h.
        columns.append(
            jnp.stack(
                [
                    whitening * normalised,
                    whitening,
                    *(alpha * whitening * d[k] for d in projected.by_lens),
                    *(
                        projected.inverse_depth * (hx * dx + hy * dy + hz * dz)
                        for dx, dy, dz in displacements
                    ),
                    projected.inverse_depth * hx,
                    projected.inverse_depth * hy,
                    projected.inverse_depth * hz,
                    py * hz - pz * hy,
                    pz * hx - px * hz,
                    px * hy - py * hx,
                    sqrt_weight * residual[k],
                ],
                axis=-2,
            )
        )
    return columns[0], columns[1], cost


def _cost_and_weight(
    square: Float[Array, "group points"],
    valid: Bool[Array, "group points"],
    unprojectable: Bool[Array, "group points"],
    loss: AbstractLoss | None,
) -> tuple[Float[Array, "group points"], Float[Array, "group points"]]:
    """Return the cost of points by their squared residuals, and their weights in the gradient."""
    if loss is None:
        cost = 0.5 * square + jnp.where(unprojectable, INVALID_PROJECTION_RESIDUAL**2, 0.0)
        return cost, jnp.ones_like(square)
    # cost = rho(s) / 2 with s = |r|^2; its gradient is rho'(s) J^T r, hence the weight rho'(s).
    rho, weight = jax.jvp(loss.rho, (square,), (jnp.ones_like(square),))
    invalid_loss = loss.rho(jnp.asarray(2.0 * INVALID_PROJECTION_RESIDUAL**2))
    cost = 0.5 * (jnp.where(valid, rho, 0.0) + jnp.where(unprojectable, invalid_loss, 0.0))
    return cost, weight


class _Projection(NamedTuple):
    """Points projected onto the unit plane, with derivatives, which are pairs of components.

    Attributes:
        distorted: the distorted point (x, y).
        valid: whether the point is visible and can be projected.
        by_lens: derivatives by each lens parameter.
        ray: the point `p` in the camera frame as `inverse_depth * p`.
        inverse_depth: one over the depth of the point, or one if the ray is the point itself.
        by_ray: derivatives by the coordinates of the ray; for a ray `(x, y, 1)` by the first two.
    """

    distorted: tuple[Array, Array]
    valid: Bool[Array, "group points"]
    by_lens: list
    ray: tuple[Array | float, ...]
    inverse_depth: Array | float
    by_ray: list


def _project_with_jacobians(
    lens: AbstractLens, in_camera: tuple[Array, Array, Array], visible: Bool[Array, "group points"]
) -> _Projection:
    """Project points onto the unit plane, with derivatives by the lens and by the point.

    Points that are invisible or cannot be projected are replaced by a point on the optical axis,
    where every lens is smooth.
    """
    lens_parameters, tree = jax.tree.flatten(lens)
    px, py, pz = in_camera

    def lens_with(lens_parameters: list) -> AbstractLens:
        """Return the lens with other parameter values."""
        return jax.tree.unflatten(tree, lens_parameters)

    if isinstance(lens, AbstractPerspectiveLens):
        in_front = pz > 0.0
        unmasked = 1.0 / jnp.where(in_front, pz, 1.0)
        on_plane = jnp.stack([px * unmasked, py * unmasked], axis=-1)
        valid = visible & in_front & lens.distort_normalised(on_plane)[1]
        # Divided again, so that XLA keeps the masked points (see `_jacobian_columns`).
        inverse_depth = 1.0 / jnp.where(valid, pz, 1.0)
        ray = tuple(jnp.where(valid, p, 0.0) / jnp.where(valid, pz, 1.0) for p in (px, py))

        def distort_plane_point(lens_parameters: list, x: Array, y: Array) -> tuple[Array, Array]:
            """Distort points on the unit plane."""
            lens = lens_with(lens_parameters)
            assert isinstance(lens, AbstractPerspectiveLens)
            distorted = lens.distort_valid(jnp.stack([x, y], axis=-1))
            return distorted[..., 0], distorted[..., 1]

        # Only the direction of a point matters: the lens maps (px / pz, py / pz) to the distorted
        # point, and has two derivatives instead of three.
        distorted, by_lens, by_ray = _value_and_derivatives(
            distort_plane_point, lens_parameters, ray
        )
        return _Projection(distorted, valid, by_lens, (*ray, 1.0), inverse_depth, by_ray)

    # Other lenses (fisheye) may see points at 90 degrees from the axis or more, which have no point
    # on the unit plane; they are differentiated by all three coordinates.
    valid = visible & lens.distort(jnp.stack(in_camera, axis=-1))[1]
    ray = tuple(
        jnp.where(valid, p, axis) for p, axis in zip(in_camera, (0.0, 0.0, 1.0), strict=True)
    )

    def distort_camera_point(
        lens_parameters: list, x: Array, y: Array, z: Array
    ) -> tuple[Array, Array]:
        """Project points in the camera frame onto the distorted unit plane."""
        distorted = lens_with(lens_parameters).distort(jnp.stack([x, y, z], axis=-1))[0]
        return distorted[..., 0], distorted[..., 1]

    distorted, by_lens, by_ray = _value_and_derivatives(distort_camera_point, lens_parameters, ray)
    return _Projection(distorted, valid, by_lens, ray, 1.0, by_ray)


def _value_and_derivatives(
    function: Callable, lens_parameters: list, coordinates: tuple[Array, ...]
) -> tuple[tuple[Array, Array], list, list]:
    """Compute the value, and the derivatives by every lens parameter and by every coordinate.

    The function is linearised once: a lens that solves an equation iteratively solves it once.
    """
    value, linear = jax.linearize(function, lens_parameters, *coordinates)
    zeros = (
        [jnp.zeros_like(n) for n in lens_parameters],
        *(jnp.zeros_like(p) for p in coordinates),
    )
    flat, tree = jax.tree.flatten(zeros)

    def derivative(k: int) -> tuple[Array, Array]:
        """Return the derivative along the k-th input, for all points at once."""
        # Points are independent, so a tangent of ones gives the derivatives of all points.
        tangent = [jnp.ones_like(t) if i == k else t for i, t in enumerate(flat)]
        return linear(*jax.tree.unflatten(tree, tangent))

    columns = [derivative(k) for k in range(len(flat))]
    return value, columns[: len(lens_parameters)], columns[len(lens_parameters) :]


def _assemble(
    gram_u: Float[Array, "views rows rows"],
    gram_v: Float[Array, "views rows rows"],
    cost: Float[Array, "views"],
) -> ViewNormalEquations:
    """Add the products of u and of v in a common order of columns.

    The order is alpha_u, alpha_v, u0, v0, lens, displacements, twist. The last row and column of
    each product belong to the residual: `J^T r` and `r^T r`.
    """
    views, rows = gram_u.shape[:2]
    size = rows + 2
    common_indices = range(4, size)
    augmented = jnp.zeros((views, size * size))
    for gram, pinhole_indices in ((gram_u, (0, 2)), (gram_v, (1, 3))):
        indices = np.array([*pinhole_indices, *common_indices])
        # Index of the source of every entry; entries that this direction lacks read the zero
        # appended at the end.
        source = np.full((size, size), rows * rows)
        source[np.ix_(indices, indices)] = np.arange(rows * rows).reshape(rows, rows)
        padded = jnp.pad(gram.reshape(views, -1), ((0, 0), (0, 1)))
        augmented = augmented + padded[:, source.ravel()]
    augmented = augmented.reshape(views, size, size)
    # r = measured - predicted and J is the Jacobian of the prediction: the gradient is -J^T r.
    return ViewNormalEquations(augmented[:, :-1, :-1], -augmented[:, :-1, -1], cost)
