"""Say how far the shading of round surfaces may displace the edges next to it.

An edge is found where the gradient of the blurred picture peaks. On a round surface the brightness
changes with its normal, up to the very edge, which moves the peak: for a step that has the gradient
g after a blur of s px, other brightness b(x) moves it by s^2 b''(0) / g. Neither the light nor the
sign is known, so that this is an error of a whole edge. Its size follows from how fast the normal
turns; a quarter turn changes the brightness by as much as the usual edge of the picture,
sqrt(2 pi) s times the edges' RMS gradient.

On all outlines of a view the normal turns towards the camera, and with it, to first order, towards
the same light: it is one unknown of the view (`LIGHT_SIGMA`), and only what differs from outline to
outline is an error of each.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .edge_line_fit import EDGE_BLUR, EdgeSamples, FittedLines, positive
from .edge_lookup import EdgeLookup
from .wireframe import Wireframe

OUTLINE_SHIFT = 0.73
"""Displacement of an outline, over s^1.5 / sqrt(R) times the usual gradient over its own.

At x px from its outline the brightness of a surface of the radius R px is b sqrt(2 x / R), which
moves the peak by b sqrt(s / R) 2^(1/4) Gamma(3/4) / sqrt(8 pi) / g, with b = sqrt(2 pi) s g_usual.
"""


LIGHT_SIGMA = 0.5 * 255.0 / (float(np.sqrt(2.0 * np.pi)) * EDGE_BLUR)
"""Gradient that stands for a light of one standard deviation, grey levels per px.

A quarter turn changes the brightness of a surface by no more than the range of the picture, which
is two standard deviations; the gradient is of an edge of as much.
"""


def shading_shifts(
    wireframe: Wireframe,
    centre: Float[Array, "3"],
    across: Float[Array, "S 3"],
    along: Float[Array, "S 3"],
) -> Float[Array, "S"]:
    """Return how far shading may displace samples of the edges, px, if they are as usual edges.

    Weaker edges are displaced by as much more. It is zero on edges between flat faces.

    Args:
        wireframe: with its outline, of a model with smooth surfaces.
        centre: the camera's centre in the object's frame, m.
        across, along: derivatives of the samples' pixels across and along their edges by the point
            in the object's frame, px/m.
    """
    assert wireframe.sample_radii is not None
    assert wireframe.sample_walls is not None
    t, walls = wireframe.sample_tangents, wireframe.sample_walls
    # One px across the edge, on the wall, is so far along the rim that nothing moves along it:
    # with w = t x n, x = (w - (along w / along t) t) / (across w).
    w = jnp.cross(t[:, None], walls)
    across_w, along_w = (jnp.einsum("sk,sfk->sf", by, w) for by in (across, along))
    along_t = (along * t).sum(axis=1)
    slide = jnp.abs(along_w) / positive(jnp.abs(across_w * along_t[:, None]))
    bends = wireframe.sample_bends
    curvature = jnp.zeros(len(t)) if bends is None else jnp.linalg.norm(bends, axis=1)
    ray = centre[None] - wireframe.samples
    is_seen = (walls * ray[:, None]).sum(axis=2) > 0.0
    # A ramp b' x on one side of an edge has b'' = b' / (sqrt(2 pi) s) once blurred.
    turn = jnp.where(is_seen, curvature[:, None] * slide, 0.0).max(axis=1)
    of_rims = EDGE_BLUR**2 * turn
    # Where the rim meets the outline, the brightness ends as on an outline.
    radii = jnp.where(turn > 0.0, jnp.abs(along_t) / positive(curvature), 0.0)
    radii = radii + wireframe.sample_radii * jnp.linalg.norm(across, axis=1)
    of_outlines = OUTLINE_SHIFT * EDGE_BLUR**1.5 / jnp.sqrt(positive(radii))
    is_outline = wireframe.sample_radii > 0.0
    return jnp.where(is_outline, of_outlines, jnp.minimum(of_rims, of_outlines))


def light_variance(
    samples: EdgeSamples,
    line: FittedLines,
    lookup: EdgeLookup,
    shifts: Float[Array, "S"],
    strengths: Float[Array, "E"],
) -> Float[Array, "E"]:
    """Return the variance of outlines by shading with the picture's usual contrast, px^2.

    Args:
        samples: of the outlines.
        line: fitted to them.
        lookup: edge points of the picture.
        shifts: of the samples by shading, as of `shading_shifts`.
        strengths: mean gradients of the lines' points.
    """
    points = (lookup.strengths > 0.0).astype(strengths.dtype).sum()
    usual = jnp.sqrt((lookup.strengths**2).sum() / jnp.maximum(points, 1.0))
    return (samples.sums(line.combination[0] * shifts) * usual / positive(strengths)) ** 2


def shifts_by_light(
    wireframe: Wireframe,
    samples: EdgeSamples,
    line: FittedLines,
    gradients: Float[Array, "S 2"],
    shifts: Float[Array, "S"],
    strengths: Float[Array, "E"],
) -> Float[Array, "E 2"]:
    """Return how a light of one standard deviation changes the two numbers of outlines, px.

    One light shades all outlines of a view: towards the brighter side where the surface is brighter
    than the ground, away from it where it is darker.

    Args:
        wireframe: with radii of curvature.
        samples, line, shifts, strengths: as in `light_variance`.
        gradients: directions of the gradients at the samples' edge points.
    """
    assert wireframe.sample_radii is not None
    brighter = jnp.sign((gradients * samples.n).sum(axis=1))
    inwards = jnp.where(wireframe.sample_radii > 0.0, shifts * brighter, 0.0)
    numbers = line.combined(samples, inwards[:, None])[..., 0]
    return numbers * (LIGHT_SIGMA / positive(strengths))[:, None]
