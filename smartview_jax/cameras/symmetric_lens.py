"""Fit a camera with any lens that is symmetric around its axis to the points of one picture.

A detection has to be tested before anything is calibrated, so neither pose nor camera are known.
With the target's points in homogeneous coordinates x and pixels p relative to the lens's axis, such
a camera is a matrix M and a polynomial w of the distance r = |p| from the axis:

    the rays (p, w(r)) and M x are parallel,     w(r) = 1 + w1 r^2 + w2 r^4 + w3 r^6

A constant w is a pinhole, for which M is the homography (or, for points that are not in a plane,
the projection matrix); w < 0 is a ray more than 90 degrees off the axis, so that fisheye lenses are
included. The first two rows of M follow linearly from the directions of p, the third row and w
linearly from the lengths. A nonlinear fit then minimises distances in the picture, with the lens's
axis free within what cameras have.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

MIN_LENS_POINTS = 6
"""Smallest number of points for which a fit leaves residuals: a homography has 8 parameters."""

_FLATNESS = 1e-3
"""Ratio of thickness to width below which points count as a plane.

Their heights then move pixels by less than a thousandth of the target's width in the picture.
"""

_AXIS_STD = 0.05
"""Standard deviation of the axis around the picture's middle, in parts of half its diagonal."""

_LENS_STD = 3.0
"""Standard deviation of w1, w2 and w3, with distances in parts of half the picture's diagonal.

It only keeps them finite where a small target does not determine them; an equidistant fisheye that
reaches 100 degrees at the picture's corners has w1 = -1.0.
"""

_RADII = np.linspace(0.0, 1.6, 400)
"""Distances from the axis at which the angle of the ray is tabulated."""

_MAX_EVALUATIONS = 40


class SymmetricLensFit(NamedTuple):
    """The misfit of a camera that was fitted to the points of a picture.

    Attributes:
        residuals: measured minus fitted pixel of every point, px.
        parameter_count: number of parameters of the pose and the lens.
    """

    residuals: Float[np.ndarray, "points 2"]
    parameter_count: int


class _Problem(NamedTuple):
    """The points of one picture in the fit's coordinates.

    Attributes:
        x: homogeneous coordinates within the plane (or space) that the points span.
        p: pixels relative to the picture's middle, in parts of half the diagonal.
        radius: half the diagonal, px.
        used: the points to fit to.
    """

    x: Float[np.ndarray, "points dimension"]
    p: Float[np.ndarray, "points 2"]
    radius: float
    used: np.ndarray


def spanned_coordinates(points: Float[np.ndarray, "points 3"]) -> np.ndarray:
    """Return coordinates in the line, plane or space that points span, with unit mean square."""
    centred = points - points.mean(axis=0)
    _, sizes, axes = np.linalg.svd(centred, full_matrices=False)
    dimension = int(np.count_nonzero(sizes > _FLATNESS * sizes[0])) if sizes[0] > 0.0 else 0
    return centred @ axes[:dimension].T / max(sizes[0] / np.sqrt(len(points)), 1e-300)


def fit_symmetric_lens(
    points: Float[np.ndarray, "points 3"],
    pixels: Float[np.ndarray, "points 2"],
    image_size: tuple[int, int],
    used: np.ndarray,
    noise: float,
    refine: bool = True,
) -> SymmetricLensFit | None:
    """Fit pose and lens to some points of one picture; None if they do not determine them.

    Args:
        points: of the target, m.
        pixels: px.
        image_size: width and height, px.
        used: mask of the points to fit to; residuals are returned for all.
        noise: standard deviation of a good point, px, beyond which a point has less weight.
        refine: whether to minimise distances in the picture; otherwise the linear solution is
            returned.
    """
    coordinates = spanned_coordinates(points)
    dimension = coordinates.shape[1]
    if dimension < 2 or np.count_nonzero(used) < MIN_LENS_POINTS + 2 * (dimension - 2):
        return None
    radius = 0.5 * float(np.hypot(*image_size))
    middle = 0.5 * (np.array(image_size) - 1.0)
    x = np.column_stack([coordinates, np.ones(len(coordinates))])
    problem = _Problem(x, (pixels - middle) / radius, radius, used)
    parameters = _linear_solution(problem)
    if refine:
        prior_std = np.array([_LENS_STD] * 3 + [_AXIS_STD] * 2)

        def cost(parameters: np.ndarray) -> np.ndarray:
            """Return the residuals of the used points and the priors, in units of the noise."""
            residuals = _residuals(problem, parameters)[used].ravel()
            return np.concatenate([residuals / noise, parameters[-5:] / prior_std])

        parameters = least_squares(
            cost, parameters, loss="soft_l1", x_scale="jac", max_nfev=_MAX_EVALUATIONS
        ).x
    # M has no scale, so it has one parameter less.
    return SymmetricLensFit(_residuals(problem, parameters), len(parameters) - 1)


def _linear_solution(problem: _Problem) -> np.ndarray:
    """Return M row by row, w1, w2, w3, and the axis's shift from the picture's middle, zero."""
    x, p = problem.x[problem.used], problem.p[problem.used]
    # p is parallel to (m1 x, m2 x):   p_x m2 x - p_y m1 x = 0.
    system = np.column_stack([-p[:, 1:] * x, p[:, :1] * x])
    m1, m2 = np.linalg.svd(system, full_matrices=False)[2][-1].reshape(2, -1)
    ray = np.column_stack([x @ m1, x @ m2])
    if np.sum(ray * p) < 0.0:
        m1, m2, ray = -m1, -m2, -ray
    # |p| m3 x = w(|p|) |ray|, with weak priors on w1, w2, w3.
    r, length = np.linalg.norm(p, axis=1), np.linalg.norm(ray, axis=1)
    terms = np.stack([r**2, r**4, r**6], axis=1)
    system = np.column_stack([r[:, None] * x, -length[:, None] * terms])
    weight = 1e-2 * np.linalg.norm(length) * np.eye(system.shape[1])[-3:]
    solution = np.linalg.lstsq(
        np.vstack([system, weight]), np.concatenate([length, np.zeros(3)]), rcond=None
    )[0]
    M = np.concatenate([m1, m2, solution[:-3]])
    return np.concatenate([M / np.linalg.norm(M), solution[-3:], np.zeros(2)])


def _residuals(problem: _Problem, parameters: np.ndarray) -> np.ndarray:
    """Return measured minus fitted pixels of all points, px."""
    M, axis = parameters[:-5].reshape(3, -1), parameters[-2:]
    w1, w2, w3 = parameters[-5:-2]
    rays = problem.x @ M.T
    across = np.linalg.norm(rays[:, :2], axis=1)
    # The angle off the axis grows with the distance from it; beyond a maximum it is held constant.
    square = _RADII**2
    angles = np.arctan2(_RADII, 1.0 + square * (w1 + square * (w2 + square * w3)))
    angles = np.maximum.accumulate(angles) + 1e-9 * _RADII
    distances = np.interp(np.arctan2(across, rays[:, 2]), angles, _RADII)
    fitted = axis + rays[:, :2] * (distances / np.maximum(across, 1e-300))[:, None]
    return (problem.p - fitted) * problem.radius
