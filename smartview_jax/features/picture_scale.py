"""Bring pictures to the size at which their edges have the width that the search is made for.

A picture that is defocused, debayered, zoomed or enlarged holds no more than a smaller one: its
edges are wide, its noise is correlated from pixel to pixel, and lengths in pixels count everything
several times. A small sharp picture holds more than the search sees in it: smoothing by a pixel is
coarser than its edges, rounds its corners, and joins edges that are next to each other. The width
of the edges is measured, and the picture is halved or enlarged until they have about the width for
which the search for edge points is made. Lengths in pixels of that picture are then lengths in
units of the edge width, and the noise of its pixels is independent as far as the search can tell.

Enlarging and halving undo each other: a picture is not halved to one that would be enlarged again,
and one that was enlarged by interpolation, which blurs the sharpest edge to a pixel, is halved.

The smoothed gradient across a blurred step is a Gaussian. The curvature of its logarithm, from
three neighbouring pixels, gives its squared width s^2 = w^2 + `SMOOTHING`^2, and so the width w of
the edge itself.
"""

from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float

from ..cameras import Camera
from .edge_points import edge_points_above, log_curvatures
from .gradient import SMOOTHING, Gradient
from .lone_edges import lone_points

STANDARD_WIDTH = 0.75
"""Width of the edges in a picture that is searched as it is: standard deviation of their blur, px.

The smoothing then adds about as much blur as the edges have.
"""

STEPS_PER_OCTAVE = 2
"""Number of scales from an enlarged picture to another of twice its size.

Few, because programs are compiled for each size of a picture.
"""

HALF = 0.5
"""The scale of reduced pictures. An object far out of focus is not smaller than a sharp one: in a
picture reduced by much more, the edges of small objects are too near to each other to be measured,
although they can be in the picture as it is."""

MIN_HALVED_WIDTH = 0.5
"""Smallest width of the edges in a halved picture, px: as wide as edges are in sharp pictures.

With narrower ones the picture holds more than the halved one. Linear interpolation to twice the
size leaves no narrower ones: a pixel's own area blurs an edge by 0.29 px, and interpolation by
another 0.41 px of the original.
"""

MAX_SCALE = 2.0
"""Largest scale. A pixel averages over its own area, which alone blurs an edge by 0.29 px; bicubic
interpolation to twice the size adds another 0.23 px, so that no edge is sharper than
`STANDARD_WIDTH` afterwards."""

MAX_ENLARGED = 640
"""Longer side of the largest enlarged picture, px: the number of cells of the distance maps of
larger pictures (`picture_evidence.MAX_CELLS`). In larger pictures smoothing hides less than the
inexact shapes of objects, and the time grows with the number of pixels."""

STRONG = 20.0
"""Gradient of edge points whose width is measured, in standard deviations of the noise.

The noise of three neighbouring gradients then changes a width by less than a tenth.
"""

SHARP_SHARE = 0.25
"""Share of the edges that are sharper than the picture's width.

Shadows, round corners and what is out of focus are blurred more than the lens does, nothing less.
"""

MIN_MEASURED = 100
"""Smallest number of edge points from which the width is taken."""


def edge_width(gradient: Gradient) -> float:
    """Return the width of the sharp edges of a picture, px; NaN where there are too few.

    It is the standard deviation of the blur of a step, without the blur by `SMOOTHING`.
    """
    points = edge_points_above(gradient, STRONG)
    # Another edge next to it makes an edge look wider or narrower.
    lone = lone_points(points)
    if lone.sum() < MIN_MEASURED:
        return np.nan
    curvatures = log_curvatures(gradient, points)[lone]
    # log exp(-x^2 / 2 s^2) has the second difference -1 / s^2 across the edge; along a row or
    # column, at the angle a to the edge's normal, it is -cos^2(a) / s^2.
    cosines = np.abs(points.normals[lone]).max(axis=1)
    squares = cosines**2 / np.maximum(curvatures, np.finfo(float).eps) - SMOOTHING**2
    return float(np.sqrt(max(np.quantile(squares, SHARP_SHARE), 0.0)))


def scale_for(width: float, image_size: tuple[int, int]) -> float:
    """Return the scale to search a picture at, from the width of its edges (px; NaN if unknown).

    It is between `HALF` and `MAX_SCALE`, and no enlarged picture exceeds `MAX_ENLARGED`.
    """
    # NaN leaves the picture as it is.
    if np.isnan(width):
        return 1.0
    side = max(image_size)
    # The mean of two pixels has a variance of 1/4 px^2.
    halved = HALF * float(np.hypot(width, 0.5))
    if halved >= MIN_HALVED_WIDTH and _enlargement(halved, HALF * side) == 1.0:
        return HALF
    return _enlargement(width, side)


def _enlargement(width: float, side: float) -> float:
    """Return the scale of a picture that is not reduced, given its edges' width and longer side."""
    largest = max(1.0, min(MAX_SCALE, MAX_ENLARGED / side))
    # Rounded down where rounding up would exceed the limit.
    steps = min(
        np.rint(STEPS_PER_OCTAVE * np.log2(STANDARD_WIDTH / max(width, np.finfo(float).tiny))),
        np.floor(STEPS_PER_OCTAVE * np.log2(largest)),
    )
    return float(2.0 ** (max(steps, 0.0) / STEPS_PER_OCTAVE))


def scaled_camera(camera: Camera, scale: float) -> Camera:
    """Return the camera of the reduced or enlarged pictures of a camera."""
    if scale == 1.0:
        return camera
    width, height = (max(1, round(scale * size)) for size in camera.image_size)
    return camera.resized((width, height))


def resized(
    grey: Float[np.ndarray, "rows columns"], camera: Camera
) -> Float[np.ndarray, "height width"]:
    """Return a picture at the size of a camera.

    Each pixel of a reduced picture is the mean of those that it covers; an enlarged one is
    interpolated.
    """
    is_enlarged = max(camera.image_size) > max(grey.shape)
    method = cv2.INTER_CUBIC if is_enlarged else cv2.INTER_AREA
    # Bicubic interpolation overshoots next to edges.
    return np.clip(cv2.resize(grey, camera.image_size, interpolation=method), 0.0, 255.0)


def gradient_at(
    scale: float, original: Gradient, searched: Float[np.ndarray, "height width"]
) -> Gradient:
    """Return the gradient of a picture that was brought to a scale times its original size."""
    gradient = Gradient.of(searched)
    if scale <= 1.0:
        return gradient
    # Interpolated noise is smooth and cannot be seen in the enlarged picture.
    return gradient._replace(sigma=_enlarged_noise(scale) * original.sigma)


@lru_cache(maxsize=8)
def _enlarged_noise(scale: float) -> float:
    """Return the noise of an enlarged picture's gradient, over the original picture's gradient.

    It follows from the gradient around one bright pixel: white noise is the sum of many of them,
    and each original pixel has `scale`^2 enlarged ones.
    """
    side = 65
    size = round(scale * side)
    point = np.zeros((side, side))
    point[side // 2, side // 2] = 1.0
    enlarged = cv2.resize(point, (size, size), interpolation=cv2.INTER_CUBIC)
    squares = [np.square(Gradient.of(grey).by_u).sum() for grey in (point, enlarged)]
    return float(np.sqrt(squares[1] / squares[0]) * side / size)
