"""Ask whether a target is stretched, where no single camera fits its pictures.

A target that is printed wider than high moves the pose of every view, and then robot and camera do
not move alike although both are right. The pictures alone tell: with the columns h1, h2 of a view's
homography from the stated plane and E the stretch, the columns of [h1 h2] E^-1 are perpendicular
unit vectors as seen by the camera,

    g1^T w g2 = 0,    g1^T w g1 = g2^T w g2,    w = K^-T K^-1

for all views with one w. Of all stretches the one is taken for which these equations, which are
linear in w, leave the least.

Reference: Zhang, A flexible new technique for camera calibration, 2000, section 3.1.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import expm
from scipy.optimize import minimize

from ..calibration import PRINT, TargetShape, flat_shape
from ..data_checks import CameraDoubt, ViewsAlone, camera_misfit
from ..dataset import Observations
from .picture_steps import Step1
from .staged_fit import CommonCameraFit

MIN_POINTS = 6
"""Smallest number of points of a plane for a homography that the noise does not decide."""

MIN_VIEWS = 4
"""Smallest number of views: each gives two equations, and six numbers are unknown."""

STRETCH_TOLERANCE = 1e-5
"""Change of the stretch at which the search ends."""

MAX_STRETCH = 0.2
"""Logarithm of the largest stretch that is asked for; a target beyond it is another one.

Printers err by thousandths. Pictures printed on another paper size err by 3 %: A4 is 1.06 times as
long as letter paper, and 1.03 times narrower, so that the axes differ by 9 %.
"""

STRETCHES_TRIED = np.linspace(-MAX_STRETCH, MAX_STRETCH, 9)
"""Along each axis, where the search begins at the best: far from flat, extreme stretches make
views of a plane seen edge on, which fit everything."""


class StretchedTarget(NamedTuple):
    """The fit of one camera to the pictures of a stretched target.

    Attributes:
        alone: the views, with the points of the stretched target.
        step1, common_fit: Steps 1 and 2 for these.
        shape: the target's shape.
        doubt: what was wrong with the camera as long as the target was taken as stated.
    """

    alone: ViewsAlone
    step1: Step1
    common_fit: CommonCameraFit
    shape: TargetShape
    doubt: CameraDoubt


def fit_of_stretched_target(
    alone: ViewsAlone,
    used: Bool[np.ndarray, "views"],
    common_fit: CommonCameraFit,
    fit_again: Callable[[Observations], tuple[Step1, CommonCameraFit]],
) -> StretchedTarget | None:
    """Return the fit of a stretched target; None if one camera fits the target as stated.

    Args:
        alone: the views, with the points as stated.
        used: mask of the views to ask.
        common_fit: the camera that fits these best.
        fit_again: function from observations to Steps 1 and 2.

    Returns:
        None, too, if one camera fits the pictures for no stretch of the target.
    """
    misfit = camera_misfit(alone, used, common_fit.camera, common_fit.camera_from_world)
    shape = None if misfit is None else likeliest_stretch(alone.observations, used)
    if misfit is None or shape is None:
        return None
    of_stretched = ViewsAlone(alone.observations.of_shape(shape))
    step1, fit = fit_again(of_stretched.observations)
    if camera_misfit(of_stretched, used, fit.camera, fit.camera_from_world) is not None:
        return None
    aspect = 2.0 * float(np.asarray(shape.coefficients)[PRINT][0] / shape.half_size)
    longer, other = ("x", "y") if aspect > 0.0 else ("y", "x")
    text = (
        "no single camera fits these pictures of the target as stated, but one does if the target "
        f"is stretched by {100.0 * abs(aspect):.2g} % along its {longer} compared with its "
        f"{other}, which is corrected: measure it"
    )
    return StretchedTarget(of_stretched, step1, fit, shape, CameraDoubt(text, misfit))


def likeliest_stretch(
    observations: Observations, used: Bool[np.ndarray, "views"]
) -> TargetShape | None:
    """Return the target with the stretch that its pictures tell best; None if they tell nothing.

    Args:
        observations: points and pixels.
        used: mask of the views to ask.
    """
    points, pixels = np.asarray(observations.points), np.asarray(observations.pixels)
    visible = np.asarray(observations.visible) & used[:, None]
    flat = flat_shape(points, visible)
    columns = np.array(list(_plane_columns(points, pixels, visible)))
    if flat is None or len(columns) < MIN_VIEWS:
        return None

    def left_over(stretch: np.ndarray) -> float:
        """Return what the equations leave, relative to their size."""
        inverse = expm(-np.array([[stretch[0], stretch[1]], [stretch[1], -stretch[0]]]))
        equations = _equations(columns @ inverse)
        values = np.linalg.svd(equations, compute_uv=False)
        return float(values[-1] / values[0])

    tried = np.stack(np.meshgrid(STRETCHES_TRIED, STRETCHES_TRIED), axis=-1).reshape(-1, 2)
    best = minimize(
        left_over,
        min(tried, key=left_over),
        method="Nelder-Mead",
        bounds=[(-MAX_STRETCH, MAX_STRETCH)] * 2,
        options={"xatol": STRETCH_TOLERANCE, "fatol": np.inf},
    )
    coefficients = np.zeros(len(flat.coefficients))
    coefficients[PRINT] = float(flat.half_size) * best.x
    return flat.with_coefficients(coefficients)


def _plane_columns(
    points: Float[np.ndarray, "views points 3"],
    pixels: Float[np.ndarray, "views points 2"],
    visible: Bool[np.ndarray, "views points"],
) -> Iterator[Float[np.ndarray, "3 2"]]:
    """Yield the first two columns of every view's homography, for pixels near one."""
    seen_pixels = pixels[visible]
    if not len(seen_pixels):
        return
    centre, size = seen_pixels.mean(axis=0), seen_pixels.std()
    for of_view, of_pixels, seen in zip(points, pixels, visible, strict=True):
        # Of a target of several planes, the plane with most points.
        heights, counts = np.unique(of_view[seen, 2].round(9), return_counts=True)
        if not len(heights) or counts.max() < MIN_POINTS:
            continue
        chosen = seen & (np.abs(of_view[:, 2] - heights[np.argmax(counts)]) < 1e-8)
        yield _homography(of_view[chosen, :2], (of_pixels[chosen] - centre) / size)[:, :2]


def _homography(
    plane: Float[np.ndarray, "points 2"], picture: Float[np.ndarray, "points 2"]
) -> Float[np.ndarray, "3 3"]:
    """Return the homography from a plane to a picture by the direct linear transform."""
    size = plane.std()
    x = np.column_stack([(plane - plane.mean(axis=0)) / size, np.ones(len(plane))])
    u, v = picture[:, :1], picture[:, 1:]
    zero = np.zeros_like(x)
    rows = np.concatenate([np.hstack([x, zero, -u * x]), np.hstack([zero, x, -v * x])])
    # The columns of the plane's axes do not depend on its origin, and on its unit alike.
    homography = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    return homography / np.linalg.norm(homography[:, :2])


def _equations(columns: Float[np.ndarray, "views 3 2"]) -> Float[np.ndarray, "equations 5"]:
    """Return Zhang's equations for w without skew: w11, w22, w13, w23, w33."""

    def products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.stack(
            [
                a[:, 0] * b[:, 0],
                a[:, 1] * b[:, 1],
                a[:, 0] * b[:, 2] + a[:, 2] * b[:, 0],
                a[:, 1] * b[:, 2] + a[:, 2] * b[:, 1],
                a[:, 2] * b[:, 2],
            ],
            axis=1,
        )

    first, second = columns[..., 0], columns[..., 1]
    return np.concatenate(
        [products(first, second), products(first, first) - products(second, second)]
    )
