"""Say how far the visible points of each view extend, and whether they lie in one plane."""

import numpy as np
from jaxtyping import Bool, Float

_COPLANARITY_TOLERANCE = 1e-3
"""Ratio of smallest to largest extent of the points below which they count as one plane."""


def extents(
    points: Float[np.ndarray, "views points 3"], visible: Bool[np.ndarray, "views points"]
) -> Float[np.ndarray, "views 3"]:
    """Return the extent of the visible points along their principal axes, ascending, m."""
    return np.sqrt(np.maximum(np.linalg.eigvalsh(scatter(points, visible)), 0.0))


def coplanar(extent: Float[np.ndarray, "views 3"]) -> Bool[np.ndarray, "views"]:
    """Return whether the points of each view lie in one plane, of any orientation."""
    return extent[:, 0] < _COPLANARITY_TOLERANCE * extent[:, 2]


def scatter(
    points: Float[np.ndarray, "views points dimensions"], visible: Bool[np.ndarray, "views points"]
) -> Float[np.ndarray, "views dimensions dimensions"]:
    """Return the scatter matrix of the visible points about their mean."""
    centred = np.where(visible[..., None], points - mean_point(points, visible)[:, None], 0.0)
    return centred.swapaxes(1, 2) @ centred


def mean_point(
    points: Float[np.ndarray, "views points dimensions"], visible: Bool[np.ndarray, "views points"]
) -> Float[np.ndarray, "views dimensions"]:
    """Return the mean of the visible points."""
    total = np.sum(np.where(visible[..., None], points, 0.0), axis=1)
    return total / np.maximum(np.sum(visible, axis=1), 1)[:, None]
