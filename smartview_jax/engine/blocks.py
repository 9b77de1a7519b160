"""From points to views: one linearisation of all observations, a small matrix a view.

An observation depends on everything but the camera through the pose of its view alone, and each
pose parameter moves that pose by a twist. So whatever is being fitted, a point has Jacobian columns
for the camera's numbers and for the six of a twist in the camera frame, and nothing here knows of
robots. A view's columns are multiplied out at once, chunk by chunk: memory does not grow with the
number of points. `chain.py` goes on from there.

The columns of u and of v are kept apart, since alpha_u and u0 do not move v, nor alpha_v and v0 u.
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
"""Whitened residual of a point that cannot be projected: never cheaper than one that can."""

CHUNK = 4096
"""Points of a view taken at once; their columns then stay in the processor's cache."""

TOGETHER, MOST_TOGETHER = 1024, 8
"""Points, and views, taken at once where views show few: every turn of a loop costs some 10 us."""


class ViewBlocks(eqx.Module):
    """Normal equations of every view in the camera's numbers and a twist of its pose.

    The columns are the camera's numbers in the order of its leaves, then `(v, w)` of
    `camera_from_world -> exp((v, w)) @ camera_from_world`.

    Attributes:
        gram: sum of `J^T J` over the view's points, whitened.
        gradient: of the cost.
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
    """Linearise every observation; see `ViewBlocks`.

    Args:
        camera: with any central lens: one whose pixels depend on a point's direction alone.
        camera_from_world: `(views)`.
        observations: `(views, points)`; what is not visible does not count.
        target_scale: by which the points are multiplied.
        pixel_sigma: of u and of v, px.
        loss: its weights make the normal equations those of iteratively reweighted least squares.
    """
    views = len(observations.visible)
    points, pixels, visible = _chunked(observations)
    pieces, count = visible.shape
    chunks = pieces // views
    group = min(pieces, MOST_TOGETHER, max(1, TOGETHER // count))

    def together(part: tuple) -> tuple[Array, Array, Array]:
        rotation, translation, points, pixels, visible = part
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
    """`columns @ columns.T` of each piece's points alone."""
    parts = jnp.split(columns, group, axis=1)
    return jnp.stack([part @ part.T for part in parts])


def _chunked(observations: Observations) -> tuple[Array, Array, Array]:
    """Points, pixels, visibility as `(views * chunks, points, ...)`, padded with unseen points."""
    views, count = observations.visible.shape
    least = max(1, -(-count // CHUNK))
    # Even parts where there are any: padding copies all observations.
    chunks = next((k for k in range(least, 2 * least) if count % k == 0), least)
    padding = chunks * -(-count // chunks) - count

    def split(x: Array) -> Array:
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
    """Columns of u and of v: alpha, centre, lens, twist, the residual; and each point's cost."""
    (x, y), valid, by_lens, by_point = _through_lens(camera.lens, in_camera, visible)
    predicted = (camera.alpha_u * x + camera.u0, camera.alpha_v * y + camera.v0)
    residual = [jnp.where(valid, (pixels[k] - predicted[k]) / pixel_sigma, 0.0) for k in range(2)]
    lost = visible & ~valid
    square = residual[0] ** 2 + residual[1] ** 2
    if loss is None:
        weight = jnp.ones_like(square)
        cost = 0.5 * square + jnp.where(lost, FAR_OFF**2, 0.0)
    else:
        rho, weight = jax.jvp(loss.rho, (square,), (jnp.ones_like(square),))
        far_off = loss.rho(jnp.asarray(2.0 * FAR_OFF**2))
        cost = 0.5 * (jnp.where(valid, rho, 0.0) + jnp.where(lost, far_off, 0.0))
    # The root is not for the derivatives alone: XLA computes what is dear once, not per column.
    root = jnp.sqrt(jnp.where(valid, weight, 0.0)) / pixel_sigma
    px, py, pz = in_camera
    found = []
    for k, (plane, alpha) in enumerate(((x, camera.alpha_u), (y, camera.alpha_v))):
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
    """Place on the unit plane, where that is valid, and its derivatives.

    The derivatives are by each number of the lens and by x, y, z of the point, all as pairs of
    components. Points that do not count are moved to the axis, where every lens is smooth.
    """
    numbers, tree = jax.tree.flatten(lens)
    px, py, pz = in_camera

    def rebuilt(numbers: list) -> AbstractLens:
        return jax.tree.unflatten(tree, numbers)

    if isinstance(lens, AbstractPerspectiveLens):
        in_front = pz > 0.0
        inverse_depth = 1.0 / jnp.where(in_front, pz, 1.0)
        place = (px * inverse_depth, py * inverse_depth)
        valid = visible & in_front & lens.distort_normalised(jnp.stack(place, axis=-1))[1]
        place = tuple(jnp.where(valid, p, 0.0) for p in place)

        def plane(numbers: list, x: Array, y: Array) -> tuple[Array, Array]:
            lens = rebuilt(numbers)
            assert isinstance(lens, AbstractPerspectiveLens)
            distorted = lens.distort_normalised(jnp.stack([x, y], axis=-1))[0]
            return distorted[..., 0], distorted[..., 1]

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
        distorted = rebuilt(numbers).distort(jnp.stack([x, y, z], axis=-1))[0]
        return distorted[..., 0], distorted[..., 1]

    value, by_lens, by_point = _derivatives(plane_of_point, numbers, place)
    return value, valid, by_lens, by_point


def _derivatives(
    function: Callable, numbers: list, place: tuple[Array, ...]
) -> tuple[tuple[Array, Array], list, list]:
    """Value, and derivatives by every number and every coordinate; the value is computed once.

    Linearised once, since a lens that solves an equation should solve it once.
    """
    value, linear = jax.linearize(function, numbers, *place)
    zeros = ([jnp.zeros_like(n) for n in numbers], *(jnp.zeros_like(p) for p in place))
    flat, tree = jax.tree.flatten(zeros)

    def along(k: int) -> tuple[Array, Array]:
        tangent = [jnp.ones_like(t) if i == k else t for i, t in enumerate(flat)]
        return linear(*jax.tree.unflatten(tree, tangent))

    columns = [along(k) for k in range(len(flat))]
    return value, columns[: len(numbers)], columns[len(numbers) :]


def _assembled(
    gram_u: Float[Array, "views rows rows"],
    gram_v: Float[Array, "views rows rows"],
    cost: Float[Array, "views"],
) -> ViewBlocks:
    """Both directions' products in one order of columns: alpha_u, alpha_v, u0, v0, lens, twist."""
    views, rows = gram_u.shape[:2]
    size = rows + 2
    shared = range(4, size)
    whole = jnp.zeros((views, size * size))
    for gram, own in ((gram_u, (0, 2)), (gram_v, (1, 3))):
        where = np.array([*own, *shared])
        # Where every entry comes from; those that this direction lacks find the zero at the end.
        source = np.full((size, size), rows * rows)
        source[np.ix_(where, where)] = np.arange(rows * rows).reshape(rows, rows)
        padded = jnp.pad(gram.reshape(views, -1), ((0, 0), (0, 1)))
        whole = whole + padded[:, source.ravel()]
    whole = whole.reshape(views, size, size)
    return ViewBlocks(whole[:, :-1, :-1], -whole[:, :-1, -1], cost)
