"""Fit lines to the edge points along all predicted edges of a picture at once.

A line is fitted to the distances of an edge's points from the prediction, robustly, so that points
of other edges have no weight.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...features import SMOOTHING, STANDARD_WIDTH
from .prediction import PredictedView
from .wireframe import Wireframe

EDGE_BLUR = float(np.hypot(STANDARD_WIDTH, SMOOTHING))
"""Blur of the edges with the smoothing of the gradient, standard deviation, px."""

POINT_OF_GRADIENT = float(np.sqrt(1.5)) / SMOOTHING * EDGE_BLUR**2
"""Standard deviation of an edge point, px, over the gradient's noise relative to its peak.

Near its peak the gradient g of an edge of the blur b is g (1 - x^2 / 2 b^2), so that noise of its
slope moves the peak by b^2 / g times the slope. White noise that is smoothed by s and
differentiated once has sqrt(3 / 2) / s times that slope.
"""

MIN_SHARE = 0.25
"""Smallest share of an edge's visible length with edge points for a line to be fitted."""

ROBUST_SCALES = (12.0, 4.0, 1.5, 0.6)
"""Scales of the robust line fit's rounds, px, each limited by the search radius."""

GRID_SIGMA = 0.005
"""Standard deviation of an edge point's position by its place between two pixels, px.

A parabola through three logarithms is exact for a Gaussian, and the area of a pixel makes the
gradient of a step a little different: by so much for a blur of 0.5 px, as in a sharp picture.
"""


class EdgeSamples(NamedTuple):
    """The samples along all edges of a model in one picture; zero where not visible.

    Attributes:
        visible: whether a sample is visible.
        p: pixels.
        d: unit directions of the edges.
        n: unit normals of the edges.
        px: length that a sample stands for, px.
        edges: index of each sample's edge.
        membership: 1 where a sample is on an edge, else 0.
    """

    visible: Bool[Array, "S"]
    p: Float[Array, "S 2"]
    d: Float[Array, "S 2"]
    n: Float[Array, "S 2"]
    px: Float[Array, "S"]
    edges: Int[Array, "S"]
    membership: Float[Array, "E S"]

    def sums(self, values: Float[Array, "S *k"]) -> Float[Array, "E *k"]:
        """Return the sums of values over the samples of each edge."""
        return self.membership @ values


def visible_samples(
    wireframe: Wireframe, view: PredictedView, visible: Bool[Array, "S"]
) -> EdgeSamples:
    """Return the samples of a predicted view, moved to where blurred edges are seen."""
    places = view.samples
    # The gradient of a blurred disc of radius R peaks s^2 / 2R inside its border, because more than
    # half of the neighbourhood of a point on a circle is outside the circle.
    if view.bends is not None:
        places = places + 0.5 * EDGE_BLUR**2 * view.bends
    d = jnp.where(visible[:, None], view.directions, 0.0)
    edges = wireframe.sample_curves
    # A product with a 0/1 matrix compiles in a fraction of a scatter's time.
    membership = (edges[None] == jnp.arange(wireframe.curve_count)[:, None]).astype(d.dtype)
    return EdgeSamples(
        visible,
        jnp.where(visible[:, None], places, 0.0),
        d,
        jnp.stack([-d[:, 1], d[:, 0]], axis=1),
        jnp.where(visible, view.sample_px, 0.0),
        edges,
        membership,
    )


def undisplaced(
    samples: EdgeSamples, clear: Bool[Array, "S"], lone: Bool[Array, "S"]
) -> Bool[Array, "S"]:
    """Return which samples have an edge point that no other edge displaces.

    Args:
        samples: of the model's edges.
        clear: samples with an edge point, away from the other edges of the model.
        lone: samples with an edge point away from the other edges of the picture.
    """
    # In texture most points have another edge next to them; there all points are used.
    lone = clear & lone
    lone_px = samples.sums(jnp.where(lone, samples.px, 0.0))
    are_enough = lone_px >= MIN_SHARE * samples.sums(samples.px)
    return jnp.where(are_enough[samples.edges], lone, clear)


class FittedLines(NamedTuple):
    """The line through the edge points of each edge.

    Attributes:
        weights: of the samples.
        total_weight: of each edge's samples; 1 where that is zero.
        numbers: the two numbers of a line, as in `EdgeLines`.
        combination: weights of the samples' distances in the two numbers.
        spread: of an edge's samples along it, px.
        residuals: distances of the samples' edge points from the line, px.
    """

    weights: Float[Array, "S"]
    total_weight: Float[Array, "E"]
    numbers: Float[Array, "E 2"]
    combination: Float[Array, "2 S"]
    spread: Float[Array, "E"]
    residuals: Float[Array, "S"]

    def combined(self, samples: EdgeSamples, values: Float[Array, "S k"]) -> Float[Array, "E 2 k"]:
        """Return the changes of the two numbers by changes of the samples' distances."""
        return jnp.stack([samples.sums(row[:, None] * values) for row in self.combination], axis=1)


def fitted_lines(
    samples: EdgeSamples, r: Float[Array, "S"], weights: Float[Array, "S"]
) -> FittedLines:
    """Return the lines through the distances `r` of the edge points along the edges.

    With t along the edge: a = sum w r / W,  b = sum w (t - t_mean) r / S,
    S = sum w (t - t_mean)^2.
    """
    edges, sums = samples.edges, samples.sums
    t = _along_edges(samples)
    W = positive(sums(weights))
    t = t - (sums(weights * t) / W)[edges]
    S = positive(sums(weights * t**2))
    spread = jnp.sqrt(S / W)
    combination = jnp.stack([weights / W[edges], weights * t * (spread / S)[edges]])
    numbers = jnp.stack([sums(row * r) for row in combination], axis=1)
    residuals = r - numbers[edges, 0] - numbers[edges, 1] * t / spread[edges]
    return FittedLines(weights, W, numbers, combination, spread, residuals)


def _along_edges(samples: EdgeSamples) -> Float[Array, "S"]:
    """Return the samples' positions along their edges, from the mean of the visible ones, px."""
    px = samples.px
    middle = samples.sums(px[:, None] * samples.p) / positive(samples.sums(px))[:, None]
    return ((samples.p - middle[samples.edges]) * samples.d).sum(axis=1)


def point_variance(
    samples: EdgeSamples,
    line: FittedLines,
    lengths: Float[Array, "E"],
    noise: Float[Array, "E"],
) -> tuple[Float[Array, "E"], Float[Array, "E"]]:
    """Return the variance of an edge's points about its line, and how many are independent.

    Args:
        samples: of the model's edges.
        line: fitted to them.
        lengths: with points, in lengths over which errors are correlated.
        noise: of the gradient, over the mean gradient of each edge's points.
    """
    independent = jnp.maximum(jnp.minimum(line.total_weight, lengths), 1.0)
    variance = samples.sums(line.weights * line.residuals**2) / line.total_weight
    # Two numbers of the line are fitted to this many independent points.
    variance = variance * independent / jnp.maximum(independent - 2.0, 1.0)
    # Few points may be on a line by chance, but each has the picture's noise.
    return jnp.maximum(variance, (POINT_OF_GRADIENT * noise) ** 2), independent


def grid_variance(samples: EdgeSamples, line: FittedLines) -> Float[Array, "E"]:
    """Return the variance of whole lines by their places in the grid of pixels, px^2.

    All points of an edge along a row or column have the same error. Along any other edge the places
    between pixels differ, and the errors cancel.
    """
    # Points lie on the row or column that crosses the edge more steeply.
    across_u = jnp.abs(samples.n[:, 0]) >= jnp.abs(samples.n[:, 1])
    phases = 2.0 * jnp.pi * jnp.where(across_u, samples.p[:, 0], samples.p[:, 1])
    waves = jnp.stack([jnp.cos(phases), jnp.sin(phases)], axis=1)
    means = samples.sums(line.weights[:, None] * waves) / line.total_weight[:, None]
    return GRID_SIGMA**2 * (means**2).sum(axis=1)


def robust_weights(
    samples: EdgeSamples,
    r: Float[Array, "S"],
    has_point: Float[Array, "S"],
    radius: Float[Array, ""],
) -> Float[Array, "S"]:
    """Return weights of the samples in the lines through `r`; outliers have zero weight."""
    edges, sums, t = samples.edges, samples.sums, _along_edges(samples)

    def reweighted(
        weights: Float[Array, "S"], largest: Float[Array, ""]
    ) -> tuple[Float[Array, "S"], Float[Array, "S"]]:
        W = positive(sums(weights))
        mean_t, mean_r = sums(weights * t) / W, sums(weights * r) / W
        t0, r0 = t - mean_t[edges], r - mean_r[edges]
        slope = sums(weights * t0 * r0) / positive(sums(weights * t0**2))
        # Geman and McClure's weight.
        scaled = (r0 - slope[edges] * t0) / jnp.minimum(radius, largest)
        return has_point / (1.0 + scaled**2) ** 2, scaled

    _, scaled = jax.lax.scan(reweighted, has_point, jnp.asarray(ROBUST_SCALES))
    # In the last round inliers have full weight, so that the noise is not underestimated.
    return jnp.where(jnp.abs(scaled[-1]) <= 1.0, has_point, 0.0)


def positive(values: Array) -> Array:
    """Return values with zeros replaced by ones, to be divided by."""
    return jnp.where(values > 0.0, values, 1.0)
