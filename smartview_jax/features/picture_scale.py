"""Reduce pictures whose edges are wide.

A picture that is defocused, debayered, zoomed or enlarged holds no more than a smaller one: its
edges are wide, its noise is correlated from pixel to pixel, and lengths in pixels count everything
several times. The width of the edges is measured, and the picture is reduced until they have the
width for which the search for edge points is made. Lengths in pixels of the reduced picture are
then lengths in units of the edge width, and the noise of its pixels is independent.

The smoothed gradient across a blurred step is a Gaussian. The curvature of its logarithm, from
three neighbouring pixels, gives its squared width s^2 = w^2 + `SMOOTHING`^2, and so the width w of
the edge itself.
"""

import cv2
import numpy as np
from jaxtyping import Float

from ..cameras import Camera
from .edge_points import edge_points_above, log_curvatures
from .gradient import SMOOTHING, Gradient
from .lone_edges import lone_points

STANDARD_WIDTH = 0.75
"""Width of the edges in a picture that is searched as it is: standard deviation of their blur, px.

The smoothing then adds about as much blur as the edges have. Sharper pictures are not enlarged:
their edges err by the object's inexact shape rather than by the blur.
"""

STEPS_PER_OCTAVE = 2
"""Number of scales from one picture to another of half its size.

Few, because programs are compiled for each size of a picture.
"""

MIN_SCALE = 0.5
"""Smallest scale. An object far out of focus is not smaller than a sharp one: in a picture reduced
by much more, the edges of small objects are too near to each other to be measured, although they
can be in the picture as it is."""

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


def scale_for(width: float) -> float:
    """Return the scale at which a picture is searched, given the width of its edges.

    It is between `MIN_SCALE` and one.

    Args:
        width: px; NaN where it is unknown.
    """
    # Compared so that NaN leaves the picture as it is.
    if not width > STANDARD_WIDTH:
        return 1.0
    ratio = max(STANDARD_WIDTH / width, MIN_SCALE)
    steps = np.rint(STEPS_PER_OCTAVE * np.log2(ratio))
    return float(2.0 ** (steps / STEPS_PER_OCTAVE))


def scaled_camera(camera: Camera, scale: float) -> Camera:
    """Return the camera of the reduced pictures of a camera."""
    if scale == 1.0:
        return camera
    width, height = (max(1, round(scale * size)) for size in camera.image_size)
    return camera.resized((width, height))


def reduced(
    grey: Float[np.ndarray, "rows columns"], camera: Camera
) -> Float[np.ndarray, "height width"]:
    """Return a picture at the size of a camera, each pixel the mean of those that it covers."""
    return cv2.resize(grey, camera.image_size, interpolation=cv2.INTER_AREA)
