"""Linearise all observations into one small matrix of normal equations per view.

Every parameter except the camera's acts on the pixels of a view only through the pose of that view,
and a change of a pose is a twist. Whatever is being fitted, the Jacobian of a point therefore has
columns for the camera's parameters and six columns for a twist in the camera frame; this file does
not depend on the robot. The products of these columns are formed at once, chunk by chunk, so that
memory does not grow with the number of points. `chain.py` continues from twists to parameters.

The columns of u and of v are kept apart, because v does not depend on alpha_u and u0, nor u on
alpha_v and v0.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..cameras import AbstractLens, AbstractPerspectiveLens, Camera
from ..dataset import Observations
from .losses import AbstractLoss

FAR_OFF = 1e3
"""Whitened residual, in pixel sigmas, of u and of v of a visible point that cannot be projected.

It is so large that a step never gains by moving points out of the lens's domain.
"""

CHUNK = 4096
"""Largest number of points of a view linearised at once; their columns fit the CPU's cache."""

TOGETHER, MOST_TOGETHER = 1024, 8
"""Largest number of points (TOGETHER) and of chunks (MOST_TOGETHER) linearised in one iteration.

Views with few points are grouped, because every iteration of a compiled loop costs some 10 us.
"""


class ViewBlocks(eqx.Module):
    """The normal equations of every view in the camera's parameters and a twist of its pose.

    The columns are the camera's parameters in the order of its leaves, then the twist `(v, w)` of
    `camera_from_world -> exp((v, w)) @ camera_from_world`.

    Attributes:
        gram: sum of `J^T J` over the points of a view, whitened.
        gradient: gradient of the cost.
        cost: half the sum of squared whitened residuals, or of the loss.
    """

    gram: Float[Array, "views columns columns"]
    gradient: Float[Array, "views columns"]
    cost: Float[Array, "views"]


def linearise_views(
    camera: Camera,
    camera_from_world: SE3,
    observations: Observations,
    target_scale: Float[Array, ""],
    pixel_sigma: Float[Array, ""],
    loss: AbstractLoss | None,
) -> ViewBlocks:
    """Compute the normal equations of every view from all its observations; see `ViewBlocks`.

    Args:
        camera: camera with any central lens, one whose pixels depend only on a point's direction.
        camera_from_world: pose of the world in each view's camera, batch shape `(views)`.
        observations: observations of shape `(views, points)`; points that are not visible do not
            count.
        target_scale: factor by which the points are multiplied.
        pixel_sigma: standard deviation of u and of v, px.
        loss: robust loss, whose weights give the normal equations of iteratively reweighted least
            squares; None is least squares.
    """
    views = len(observations.visible)
    points, pixels, visible = _chunked(observations)
    pieces, count = visible.shape
    chunks = pieces // views
    group = min(pieces, MOST_TOGETHER, max(1, TOGETHER // count))

    def together(part: tuple) -> tuple[Array, Array, Array]:
        """Linearise one group of chunks."""
        rotation, translation, points, pixels, visible = part
        # p = scale R X + t, with X the point on the target and p the point in the camera frame.
        # A product a piece: batched products of small matrices are several times slower.
        in_camera = jnp.concatenate(
            [
                (target_scale * rotation[k]) @ points[k].T + translation[k][:, None]
                for k in range(group)
            ],
            axis=1,
        )
        along_u, along_v, cost = _columns(
            camera, in_camera, pixels.reshape(-1, 2).T, visible.ravel(), pixel_sigma, loss
        )
        return _grams(along_u, group), _grams(along_v, group), cost.reshape(group, -1).sum(axis=1)

    def grouped(x: Array) -> Array:
        """Arrange an array of chunks in groups, padded with zeros (unseen points) at the end."""
        wide = jnp.pad(x, ((0, -pieces % group), *((0, 0),) * (x.ndim - 1)))
        return wide.reshape(-1, group, *x.shape[1:])

    rotations = jnp.repeat(camera_from_world.rotation().as_matrix(), chunks, axis=0)
    translations = jnp.repeat(camera_from_world.translation(), chunks, axis=0)
    parts = tuple(grouped(x) for x in (rotations, translations, points, pixels, visible))
    gram_u, gram_v, cost = (
        x.reshape(-1, *x.shape[2:])[:pieces].reshape(views, chunks, *x.shape[2:]).sum(axis=1)
        for x in jax.lax.map(together, parts)
    )
    return _assembled(gram_u, gram_v, cost)


def _grams(columns: Float[Array, "rows points"], group: int) -> Float[Array, "group rows rows"]:
    """Compute `columns @ columns.T` separately for each chunk of points."""
    parts = jnp.split(columns, group, axis=1)
    return jnp.stack([part @ part.T for part in parts])


def _chunked(observations: Observations) -> tuple[Array, Array, Array]:
    """Split points, pixels and visibility into chunks, `(views * chunks, points, ...)`.

    The last chunk of a view is padded with unseen points where the chunks do not come out even.
    """
    views, count = observations.visible.shape
    least = max(1, -(-count // CHUNK))
    # A number of chunks that divides the points evenly is preferred: padding copies all
    # observations.
    chunks = next((k for k in range(least, 2 * least) if count % k == 0), least)
    padding = chunks * -(-count // chunks) - count

    def split(x: Array) -> Array:
        """Split one array into chunks."""
        wide = jnp.pad(x, ((0, 0), (0, padding), *((0, 0),) * (x.ndim - 2))) if padding else x
        return wide.reshape(views * chunks, -1, *x.shape[2:])

    return split(observations.points), split(observations.pixels), split(observations.visible)


def _columns(
    camera: Camera,
    in_camera: Float[Array, "3 points"],
    pixels: Float[Array, "2 points"],
    visible: Bool[Array, "points"],
    pixel_sigma: Float[Array, ""],
    loss: AbstractLoss | None,
) -> tuple[Float[Array, "rows points"], Float[Array, "rows points"], Float[Array, "points"]]:
    """Compute the Jacobian columns of u and of v, and the cost of each point.

    The rows of both results are: alpha, centre, lens parameters, twist, residual.

    A visible point that cannot be projected has zero columns and the cost of `FAR_OFF`.
    """
    # u = alpha_u x + u0 and v = alpha_v y + v0, with (x, y) the distorted point on the unit plane;
    # r = (measured - predicted) / sigma.
    (x, y), valid, by_lens, by_point = _through_lens(camera.lens, in_camera, visible)
    predicted = (camera.alpha_u * x + camera.u0, camera.alpha_v * y + camera.v0)
    residual = [jnp.where(valid, (pixels[k] - predicted[k]) / pixel_sigma, 0.0) for k in range(2)]
    lost = visible & ~valid
    square = residual[0] ** 2 + residual[1] ** 2
    if loss is None:
        weight = jnp.ones_like(square)
        cost = 0.5 * square + jnp.where(lost, FAR_OFF**2, 0.0)
    else:
        # cost = rho(s) / 2 with s = |r|^2; its gradient is rho'(s) J^T r, hence the weight rho'(s).
        rho, weight = jax.jvp(loss.rho, (square,), (jnp.ones_like(square),))
        far_off = loss.rho(jnp.asarray(2.0 * FAR_OFF**2))
        cost = 0.5 * (jnp.where(valid, rho, 0.0) + jnp.where(lost, far_off, 0.0))
    # Columns and residual are multiplied by sqrt(weight), so that their products are weighted once.
    # With the square root XLA evaluates the expensive expression once, not again for every column.
    root = jnp.sqrt(jnp.where(valid, weight, 0.0)) / pixel_sigma
    px, py, pz = in_camera
    found = []
    for k, (plane, alpha) in enumerate(((x, camera.alpha_u), (y, camera.alpha_v))):
        # Pose Jacobian: the twist (v, w) moves a point by dp = v + w x p. With g = du/dp the chain
        # rule gives du = g . v + g . (w x p) = g . v + (p x g) . w, so the six columns are (g, p x
        # g).
        gx, gy, gz = (alpha * root * g[k] for g in by_point)
        found.append(
            jnp.stack(
                [
                    root * plane,
                    root,
                    *(alpha * root * column[k] for column in by_lens),
                    gx,
                    gy,
                    gz,
                    py * gz - pz * gy,
                    pz * gx - px * gz,
                    px * gy - py * gx,
                    root * pixel_sigma * residual[k],
                ]
            )
        )
    return found[0], found[1], cost


def _through_lens(
    lens: AbstractLens, in_camera: Float[Array, "3 points"], visible: Bool[Array, "points"]
) -> tuple[tuple[Array, Array], Bool[Array, "points"], list, list]:
    """Project points onto the unit plane, with derivatives by the lens and by the point.

    Points that do not count are replaced by a point on the optical axis, where every lens is
    smooth.

    Returns:
        The distorted point (x, y), where it is valid, its derivatives by each lens parameter, and
        its derivatives by the three coordinates of the point; derivatives are pairs of components.
    """
    numbers, tree = jax.tree.flatten(lens)
    px, py, pz = in_camera

    def rebuilt(numbers: list) -> AbstractLens:
        """Return the lens with other parameter values."""
        return jax.tree.unflatten(tree, numbers)

    if isinstance(lens, AbstractPerspectiveLens):
        in_front = pz > 0.0
        inverse_depth = 1.0 / jnp.where(in_front, pz, 1.0)
        place = (px * inverse_depth, py * inverse_depth)
        valid = visible & in_front & lens.distort_normalised(jnp.stack(place, axis=-1))[1]
        place = tuple(jnp.where(valid, p, 0.0) for p in place)

        def plane(numbers: list, x: Array, y: Array) -> tuple[Array, Array]:
            """Distort points on the unit plane."""
            lens = rebuilt(numbers)
            assert isinstance(lens, AbstractPerspectiveLens)
            distorted = lens.distort_normalised(jnp.stack([x, y], axis=-1))[0]
            return distorted[..., 0], distorted[..., 1]

        # a = px / pz, b = py / pz; by the chain rule d/dpx = (d/da) / pz, d/dpy = (d/db) / pz and
        # d/dpz = -(a d/da + b d/db) / pz: two derivatives of the lens instead of three.
        value, by_lens, (by_x, by_y) = _derivatives(plane, numbers, place)
        by_point = [
            tuple(inverse_depth * d for d in by_x),
            tuple(inverse_depth * d for d in by_y),
            tuple(
                -inverse_depth * (place[0] * a + place[1] * b)
                for a, b in zip(by_x, by_y, strict=True)
            ),
        ]
        return value, valid, by_lens, by_point

    valid = visible & lens.distort(in_camera.T)[1]
    place = tuple(
        jnp.where(valid, p, axis) for p, axis in zip(in_camera, (0.0, 0.0, 1.0), strict=True)
    )

    def plane_of_point(numbers: list, x: Array, y: Array, z: Array) -> tuple[Array, Array]:
        """Project points in the camera frame onto the distorted unit plane."""
        distorted = rebuilt(numbers).distort(jnp.stack([x, y, z], axis=-1))[0]
        return distorted[..., 0], distorted[..., 1]

    value, by_lens, by_point = _derivatives(plane_of_point, numbers, place)
    return value, valid, by_lens, by_point


def _derivatives(
    function: Callable, numbers: list, place: tuple[Array, ...]
) -> tuple[tuple[Array, Array], list, list]:
    """Compute the value, and the derivatives by every lens parameter and by every coordinate.

    The function is linearised once: a lens that solves an equation iteratively solves it once.
    """
    value, linear = jax.linearize(function, numbers, *place)
    zeros = ([jnp.zeros_like(n) for n in numbers], *(jnp.zeros_like(p) for p in place))
    flat, tree = jax.tree.flatten(zeros)

    def along(k: int) -> tuple[Array, Array]:
        """Return the derivative along the k-th input, for all points at once."""
        # Points are independent, so that one tangent of ones gives the derivative of every point.
        tangent = [jnp.ones_like(t) if i == k else t for i, t in enumerate(flat)]
        return linear(*jax.tree.unflatten(tree, tangent))

    columns = [along(k) for k in range(len(flat))]
    return value, columns[: len(numbers)], columns[len(numbers) :]


def _assembled(
    gram_u: Float[Array, "views rows rows"],
    gram_v: Float[Array, "views rows rows"],
    cost: Float[Array, "views"],
) -> ViewBlocks:
    """Add the products of u and of v in one order of columns.

    The order is alpha_u, alpha_v, u0, v0, lens, twist. The last row and column of each product
    belong to the residual: `J^T r` and `r^T r`.
    """
    views, rows = gram_u.shape[:2]
    size = rows + 2
    shared = range(4, size)
    whole = jnp.zeros((views, size * size))
    for gram, own in ((gram_u, (0, 2)), (gram_v, (1, 3))):
        where = np.array([*own, *shared])
        # Index of the source of every entry; entries that this direction lacks read the zero
        # appended at the end.
        source = np.full((size, size), rows * rows)
        source[np.ix_(where, where)] = np.arange(rows * rows).reshape(rows, rows)
        padded = jnp.pad(gram.reshape(views, -1), ((0, 0), (0, 1)))
        whole = whole + padded[:, source.ravel()]
    whole = whole.reshape(views, size, size)
    # r = measured - predicted and J is the Jacobian of the prediction: the gradient is -J^T r.
    return ViewBlocks(whole[:, :-1, :-1], -whole[:, :-1, -1], cost)
