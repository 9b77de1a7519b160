"""The shape of a flat target: it bows a little, and is printed a little wider than high.

A sheet on a board is never flat: bows of 0.1 to 0.3 mm are usual, and they cost as much accuracy of
a hand-eye calibration as everything else together. Five numbers, in metres at the target's edge,
describe the lowest order of the deviation: the sheet bends about two axes and twists, and it is
stretched along one axis more than along the other, or sheared. Equal stretch of both axes is the
target's scale.
"""

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from ..runtime.array_namespace import (
    AnyArray,
    array_namespace,
    to_device,
    to_device_together,
)
from ..runtime.compilation import is_traced
from ..runtime.modules import HostModule, with_fields

SHAPE_NAMES = ("bow_x", "bow_xy", "bow_y", "aspect", "shear")
"""Names of the coefficients."""

BOW, PRINT = slice(0, 3), slice(3, 5)
"""The coefficients out of the target's plane and within it."""

PLANE_TOLERANCE = 1e-6
"""Points whose heights differ by less than this, m, are in one plane."""

MIN_POINTS_PER_PLANE = 4
"""Smallest number of points per plane, on average, of a target that is treated as flat."""

EDGE = 1.25
"""Distance from the centre, in half sizes, beyond which the shape keeps its value."""


class TargetShape(HostModule):
    """The deviation of a flat target's points from their stated places.

    Attributes:
        centre: centre of the target in its plane (x, y), m.
        half_size: half of its longer side, m.
        mean_products: means of x^2, x y and y^2 over its points, x and y being distances from the
            centre over the half size. The bow is relative to the mean plane of the points.
        coefficients: displacement at the edge by each of `SHAPE_NAMES`, m.
    """

    centre: Float[Array, "2"]
    half_size: Float[Array, ""]
    mean_products: Float[Array, "3"]
    coefficients: Float[Array, "5"]

    def displaced(self, points: Float[AnyArray, "*points 3"]) -> Float[AnyArray, "*points 3"]:
        """Return the true positions of points, for a target of its stated size.

        Outside of `jit` and the like they are a NumPy array.

        Args:
            points: points as stated, in the target's frame, m.
        """
        # On the host outside of a transformation: a program of its own would take longer.
        shape, stated = self, points
        if not is_traced(self, points):
            shape, stated = jax.tree.map(np.asarray, (self, points))
        xp = array_namespace(shape, stated)
        displacement = xp.einsum("...ci,c->...i", shape.directions(stated), shape.coefficients)
        return stated + displacement

    def directions(self, points: Float[AnyArray, "*points 3"]) -> Float[AnyArray, "*points 5 3"]:
        """Return how each coefficient displaces each point, per metre."""
        xp = array_namespace(self, points)
        # A point that is not on the target must not be moved by an extrapolated parabola.
        x, y = (
            xp.clip((points[..., k] - self.centre[k]) / self.half_size, -EDGE, EDGE)
            for k in range(2)
        )
        zero = xp.zeros_like(x)
        products = (x * x, x * y, y * y)
        bow = (p - mean for p, mean in zip(products, self.mean_products, strict=True))
        along_x = xp.stack([zero, zero, zero, x, y], axis=-1)
        along_y = xp.stack([zero, zero, zero, -y, x], axis=-1)
        along_z = xp.stack([*bow, zero, zero], axis=-1)
        return xp.stack([along_x, along_y, along_z], axis=-1)

    def with_coefficients(self, coefficients: Float[np.ndarray, "5"]) -> "TargetShape":
        """Return the shape with other coefficients."""
        return with_fields(self, coefficients=to_device(coefficients))


def flat_shape(
    points: Float[np.ndarray, "views points 3"], visible: Bool[np.ndarray, "views points"]
) -> TargetShape | None:
    """Return the shape of a target that is exactly as stated; None if the target is not flat.

    A target may lie in several parallel planes, as a board does that is seen at several heights.

    Args:
        points: points of the target in its frame in each view, m.
        visible: mask of the visible points.
    """
    distinct = np.unique(np.round(points[visible] / PLANE_TOLERANCE), axis=0) * PLANE_TOLERANCE
    planes = len(np.unique(np.round(distinct[:, 2] / PLANE_TOLERANCE))) if len(distinct) else 1
    if len(distinct) < MIN_POINTS_PER_PLANE * planes:
        return None
    low, high = distinct[:, :2].min(axis=0), distinct[:, :2].max(axis=0)
    half_size = 0.5 * float((high - low).max())
    if not half_size > 0.0:
        return None
    x, y = ((distinct[:, :2] - 0.5 * (low + high)) / half_size).T
    arrays = (
        0.5 * (low + high),
        np.asarray(half_size),
        np.array([np.mean(x * x), np.mean(x * y), np.mean(y * y)]),
        np.zeros(len(SHAPE_NAMES)),
    )
    return TargetShape(*to_device_together(arrays))


def shape_to_dict(shape: TargetShape) -> dict[str, object]:
    """Return a shape as plain numbers, all in metres but the mean products."""
    return {
        "centre": np.asarray(shape.centre).tolist(),
        "half_size": float(shape.half_size),
        "mean_products": np.asarray(shape.mean_products).tolist(),
        "coefficients": dict(
            zip(SHAPE_NAMES, np.asarray(shape.coefficients).tolist(), strict=True)
        ),
    }


def shape_from_dict(entry: dict) -> TargetShape:
    """Return the shape from the result of `shape_to_dict`."""
    coefficients = [entry["coefficients"][name] for name in SHAPE_NAMES]
    numbers = (entry["centre"], entry["half_size"], entry["mean_products"], coefficients)
    return TargetShape(*(to_device(np.array(x, dtype=float)) for x in numbers))
