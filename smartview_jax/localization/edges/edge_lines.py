"""Measure the edges of a model in a picture: one fitted line for each predicted edge.

An arc of a round rim, or a piece of the outline of a smooth surface, is measured as an edge is.

For samples along each predicted edge the nearest edge point along the edge's normal is taken, with
the right orientation and either polarity. A line is fitted to the distances of these points from
the prediction. Two numbers hold all information of an edge on the pose: the distance of the line at
the mean of its points, and its slope times their spread. Their errors are independent. Neighbouring
edge points are correlated, because they share smoothed pixels and because real edges are rough; the
covariance of the line accounts for it, by the length that was measured in the picture.

Points that another edge displaces are left out: near other edges of the model and, where enough
other points remain, next to any other edge of the picture, such as the border of a shadow.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...cameras import AnyCamera, camera_axes
from ...features import CLEARANCE
from ...runtime.array_namespace import AnyArray
from ...runtime.compilation import compiled_optimised
from .edge_line_fit import (
    EDGE_BLUR,
    MIN_SHARE,
    EdgeSamples,
    fitted_lines,
    grid_variance,
    point_variance,
    positive,
    robust_weights,
    undisplaced,
    visible_samples,
)
from .edge_lookup import DEPTH_CELL_PX, EdgeLookup
from .outlines import with_outline
from .prediction import centre_in_object, predict_view, within_picture
from .shading import light_variance, shading_shifts, shifts_by_light
from .wireframe import Wireframe

EXPLAINED_DISTANCE = 2.0
"""Largest distance, px, of an edge point from the predicted edge that it explains."""

INDEPENDENT_LENGTH = 12.0
"""Length of an edge, px, that counts as one independent observation (found or missing)."""

MAX_RADIUS = 12
"""Largest distance, px, of an edge point from the predicted edge."""

MAX_ALONG = 1.5
"""Largest distance of an edge point from the normal along which it is looked for, px."""

ALONG_WEIGHT = 2.0
"""Weight of the distance along the edge relative to the distance along the normal, where the
nearest edge point is chosen."""

MIN_ALIGNMENT = 0.9
"""Smallest cosine, about 25 degrees, between an edge point's gradient and the edge's normal."""

ROUNDED_REACH = 2.0 * EDGE_BLUR
"""Distance, px, from an edge of another direction within which a blurred edge is rounded: its
points are displaced or have neither direction."""

MIN_EDGE_PX = 8.0
"""Visible length, px, below which an edge is not measured."""

MIN_LINE_POINTS = 4.0
"""Smallest number of samples in a line: two more than its two numbers."""

HIDING_DEPTH = 0.01
"""Share of its depth by which a point must be behind a known surface to be hidden by it.

Objects touch, and the surface is known in cells of `DEPTH_CELL_PX` only."""


class EdgeLines(NamedTuple):
    """The lines fitted to edge points along predicted edges, and these points.

    The two numbers of a line are its distance (px, measured minus predicted along `normals`) at the
    mean of its points, and its slope times the spread of its points.

    Attributes:
        offsets: the two numbers; zero where there is no line.
        variances: their variances, px^2, independent of each other.
        by_pose: derivatives of the predicted numbers by the tangent of the object's pose.
        measured: whether there is a line.
        visible_px: visible length of each edge, px, without what has no edge point where the blur
            rounds corners (`ROUNDED_REACH`).
        explained_px: visible length with an edge point within the radius, px.
        found_px: visible length where the line has points, px.
        strength: mean gradient of the line's points, grey levels per px.
        scatter: standard deviation of the points about their line, px.
        tolerance_px: standard deviation of the two numbers together by the model's tolerance, px.
        samples: predicted pixels; zero where not visible.
        sample_px: visible length that each sample stands for, px.
        normals: unit normals of the predicted edges at the samples; zero where not visible.
        distances: distances of the samples' edge points along the normals, px; NaN where there is
            none.
        combination: weights of the samples' distances; their weighted sums over an edge are its two
            numbers.
        points: index of the edge point of each sample.
        in_picture: share of the vertices within the picture, hidden or not.
        behind_px: length of the edges hidden by a known surface, px.
        outline: places in the object's frame, m, and edges of the samples of a model whose outline
            depends on the viewpoint; None for all others, whose samples are the wireframe's.
        by_light: by how much a light of one standard deviation changes the two numbers, px; zero
            but on outlines. None as above.
    """

    offsets: Float[AnyArray, "*views E 2"]
    variances: Float[AnyArray, "*views E 2"]
    by_pose: Float[AnyArray, "*views E 2 6"]
    measured: Bool[AnyArray, "*views E"]
    visible_px: Float[AnyArray, "*views E"]
    explained_px: Float[AnyArray, "*views E"]
    found_px: Float[AnyArray, "*views E"]
    strength: Float[AnyArray, "*views E"]
    scatter: Float[AnyArray, "*views E"]
    tolerance_px: Float[AnyArray, "*views E"]
    samples: Float[AnyArray, "*views S 2"]
    sample_px: Float[AnyArray, "*views S"]
    normals: Float[AnyArray, "*views S 2"]
    distances: Float[AnyArray, "*views S"]
    combination: Float[AnyArray, "*views 2 S"]
    points: Int[AnyArray, "*views S"]
    in_picture: Float[AnyArray, "*views"]
    behind_px: Float[AnyArray, "*views"]
    outline: tuple[Float[AnyArray, "*views S 3"], Int[AnyArray, "*views S"]] | None = None
    by_light: Float[AnyArray, "*views E 2"] | None = None


def edge_lines(
    wireframe: Wireframe,
    camera: AnyCamera,
    lookup: EdgeLookup,
    camera_from_object: Float[Array, "4 4"],
    radius: Float[Array, ""],
) -> EdgeLines:
    """Return the lines fitted to edge points along the visible edges of a model in one picture.

    Args:
        wireframe: of the model.
        camera: intrinsics and lens.
        lookup: edge points of this picture, without the view axis.
        camera_from_object: pose of the object in the camera's frame.
        radius: largest distance of an edge point from its predicted edge, px.
    """
    wireframe = with_outline(wireframe, centre_in_object(camera_from_object))
    view = predict_view(wireframe, camera, camera_from_object)
    in_sight = view.sample_visible & lookup.valid
    behind = in_sight & _is_behind(wireframe, lookup, camera_from_object, view.samples)
    samples = visible_samples(wireframe, view, in_sight & ~behind)
    r, point = _nearest_along_normals(lookup, samples.p, samples.n, samples.d, radius)
    has_point = samples.visible & jnp.isfinite(r)
    r = jnp.where(has_point, r, 0.0)
    gap, turned_gap = _gaps_to_others(wireframe, view.vertices, view.edge_px, samples)
    clear = undisplaced(samples, has_point & (gap > CLEARANCE), lookup.lone[point])
    line = fitted_lines(samples, r, robust_weights(samples, r, clear.astype(r.dtype), radius))

    def by_pose(directions: Float[Array, "S 2"]) -> Float[Array, "S 6"]:
        return _by_pose(wireframe, camera, camera_from_object, directions, samples.visible)

    J = by_pose(samples.n)
    sums, px = samples.sums, samples.px
    found_px, visible_px = sums(px * line.weights), sums(px)
    measured = (visible_px >= MIN_EDGE_PX) & (found_px >= MIN_SHARE * visible_px)
    measured &= line.total_weight >= MIN_LINE_POINTS
    strengths = sums(line.weights * lookup.strengths[point]) / line.total_weight
    # The line as a whole may be off by so much at either end, independently. The derivative of the
    # distance by a shift of the object is the number of pixels to a metre.
    px_per_metre = sums(line.combination[0] * jnp.linalg.norm(J[:, :3], axis=1))
    tolerance = wireframe.tolerance * px_per_metre
    whole = grid_variance(samples, line) + tolerance**2
    by_light = None
    if wireframe.smooth is not None:
        centre = centre_in_object(camera_from_object)
        shifts = shading_shifts(wireframe, centre, J[:, :3], by_pose(samples.d)[:, :3])
        whole = whole + light_variance(samples, line, lookup, shifts, strengths)
        by_light = shifts_by_light(
            wireframe, samples, line, lookup.normals[point], shifts, strengths
        )
        by_light = jnp.where(measured[:, None], by_light, 0.0)
    variance, independent = point_variance(
        samples,
        line,
        found_px / lookup.correlated_lengths,
        lookup.gradient_sigmas / positive(strengths),
    )
    tilted = jnp.minimum(2.0 * line.spread / jnp.maximum(found_px, 1.0), 1.0)
    variances = jnp.stack(
        [variance / independent + whole, variance / independent + whole * tilted**2], axis=1
    )
    # The blur rounds corners: what is missing there is no evidence against the object.
    counted_px = jnp.where(has_point | (turned_gap > ROUNDED_REACH), px, 0.0)
    keep = measured[:, None]
    in_picture = (wireframe.vertex_mask & within_picture(view.vertices, camera)).sum()
    return EdgeLines(
        jnp.where(keep, line.numbers, 0.0),
        jnp.where(keep, variances, 1.0),
        jnp.where(keep[..., None], line.combined(samples, J), 0.0),
        measured,
        sums(counted_px),
        sums(jnp.where(has_point, px, 0.0)),
        jnp.where(measured, found_px, 0.0),
        jnp.where(measured, strengths, 0.0),
        jnp.sqrt(variance),
        jnp.where(measured, tolerance * jnp.sqrt(1.0 + tilted**2), 0.0),
        samples.p,
        px,
        samples.n,
        jnp.where(has_point, r, jnp.nan),
        jnp.where(measured[samples.edges][None], line.combination, 0.0),
        point,
        in_picture / wireframe.vertex_mask.sum(),
        jnp.where(behind, view.sample_px, 0.0).sum(),
        None if wireframe.smooth is None else (wireframe.samples, wireframe.sample_curves),
        by_light,
    )


def _is_behind(
    wireframe: Wireframe,
    lookup: EdgeLookup,
    camera_from_object: Float[Array, "4 4"],
    samples: Float[Array, "S 2"],
) -> Bool[Array, "S"]:
    """Return which samples are behind a known surface."""
    rows, columns = lookup.nearest.shape
    depth = wireframe.samples @ camera_from_object[2, :3] + camera_from_object[2, 3]
    # Pixel 0 reaches from -0.5 to 0.5.
    cell = jnp.floor((jnp.nan_to_num(samples) + 0.5) / DEPTH_CELL_PX).astype(jnp.int32)
    nearest = lookup.nearest[
        jnp.clip(cell[:, 1], 0, rows - 1), jnp.clip(cell[:, 0], 0, columns - 1)
    ]
    return nearest * depth > 1.0 + HIDING_DEPTH


def _by_pose(
    wireframe: Wireframe,
    camera: AnyCamera,
    camera_from_object: Float[Array, "4 4"],
    normals: Float[Array, "S 2"],
    visible: Bool[Array, "S"],
) -> Float[Array, "S 6"]:
    """Return derivatives of the samples' positions along directions by the tangent of the pose."""
    # n . pixel has the gradient g = n^T D R by the point in the object's frame, where D is the
    # pixel's derivative by the point in the camera's frame; by the tangent (v, w) it is g and p x
    # g.
    R, t = camera_from_object[:3, :3], camera_from_object[:3, 3]
    p = wireframe.samples

    def along_normals(in_camera: Float[Array, "S 3"]) -> Float[Array, ""]:
        pixels = jnp.where(visible[:, None], camera.project(in_camera)[0], 0.0)
        return (pixels * normals).sum()

    # Samples that are not visible are put in front of the camera, where the derivative is finite.
    in_camera = jnp.where(visible[:, None], p @ R.T + t[None], jnp.array([[0.0, 0.0, 1.0]]))
    g = jax.grad(along_normals)(in_camera) @ R
    return jnp.where(visible[:, None], jnp.concatenate([g, jnp.cross(p, g)], axis=1), 0.0)


def _gaps_to_others(
    wireframe: Wireframe,
    vertices: Float[Array, "V 2"],
    edge_px: Float[Array, "E"],
    samples: EdgeSamples,
) -> tuple[Float[Array, "S"], Float[Array, "S"]]:
    """Return how far samples are from all visible edges but their own edge or rim, px.

    The second number leaves out the edges whose points a sample's edge would take for its own,
    because they have its direction (`MIN_ALIGNMENT`).

    Args:
        wireframe: of the model.
        vertices: pixels of the vertices.
        edge_px: visible lengths of the edges, px.
        samples: of the edges.
    """
    a, b = (vertices[wireframe.edges[:, k]] for k in (0, 1))
    is_visible = (edge_px > 0.0) & jnp.isfinite(a + b).all(axis=1)
    a, b = (jnp.where(is_visible[:, None], x, 0.0) for x in (a, b))
    squared_lengths = positive(((b - a) ** 2).sum(axis=1))
    along = (b - a) / squared_lengths[:, None]
    gap = samples.p[:, None] - a[None]
    s = jnp.clip((gap * along[None]).sum(axis=2), 0.0, 1.0)
    squared = ((gap - s[..., None] * (b - a)[None]) ** 2).sum(axis=2)
    is_own_edge = wireframe.sample_chains[:, None] == wireframe.edge_chains[None]
    squared = jnp.where(is_own_edge | ~is_visible[None], jnp.inf, squared)
    cosines = jnp.abs(samples.d @ (b - a).T) / jnp.sqrt(squared_lengths)[None]
    turned = jnp.where(cosines < MIN_ALIGNMENT, squared, jnp.inf)
    return jnp.sqrt(squared.min(axis=1)), jnp.sqrt(turned.min(axis=1))


def _nearest_along_normals(
    lookup: EdgeLookup,
    p: Float[Array, "S 2"],
    n: Float[Array, "S 2"],
    d: Float[Array, "S 2"],
    radius: Float[Array, ""],
) -> tuple[Float[Array, "S"], Int[Array, "S"]]:
    """Return the distance along each normal to the nearest edge point, and the point's index.

    The distance is infinite where there is none.
    """
    rows, columns = lookup.cells.shape
    steps = jnp.arange(-MAX_RADIUS, MAX_RADIUS + 1).astype(p.dtype)
    places = jnp.round(p[:, None] + steps[None, :, None] * n[:, None]).astype(jnp.int32)
    u, v = places[..., 0], places[..., 1]
    within = (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
    index = lookup.cells[jnp.clip(v, 0, rows - 1), jnp.clip(u, 0, columns - 1)]
    gap = lookup.pixels[index] - p[:, None]
    across, along = (gap * n[:, None]).sum(axis=-1), (gap * d[:, None]).sum(axis=-1)
    alignment = jnp.abs((lookup.normals[index] * n[:, None]).sum(axis=-1))
    usable = within & (jnp.abs(across) <= radius) & (jnp.abs(along) <= MAX_ALONG)
    # Among neighbouring points of one edge take the point on the normal: the one nearest to the
    # prediction would bias the line towards it.
    distance = jnp.abs(across) + ALONG_WEIGHT * jnp.abs(along)
    distance = jnp.where(usable & (alignment >= MIN_ALIGNMENT), distance, jnp.inf)
    best = jnp.argmin(distance, axis=1)[:, None]
    r = jnp.take_along_axis(jnp.where(jnp.isfinite(distance), across, jnp.inf), best, axis=1)
    return r[:, 0], jnp.take_along_axis(index, best, axis=1)[:, 0]


@compiled_optimised
def lines_in_views(
    wireframe: Wireframe,
    camera: AnyCamera,
    lookup: EdgeLookup,
    camera_from_world: Float[Array, "views 4 4"],
    world_from_object: Float[Array, "4 4"],
    radius: Float[Array, ""],
) -> EdgeLines:
    """Return the lines of `edge_lines` in all views."""

    def in_view(
        view_camera: AnyCamera, view_lookup: EdgeLookup, matrix: Float[Array, "4 4"]
    ) -> EdgeLines:
        return edge_lines(wireframe, view_camera, view_lookup, matrix @ world_from_object, radius)

    return jax.vmap(in_view, (camera_axes(camera), 0, 0))(camera, lookup, camera_from_world)
