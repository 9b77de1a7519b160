"""Turn depth pictures and point clouds into points of a target: one for each detected corner.

A depth at a corner itself is one noisy number, and often missing. A small patch of the target about
the corner is flat, so that its points are an affine function of the pixel; the function's value at
the corner averages the noise of all of them.
"""

import os
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from ..cameras import Camera
from ..dataset import MAD_TO_SIGMA
from ..detection import picture_bytes
from ..geometry import LENGTH_UNITS
from ..runtime.array_namespace import to_device

PATCH_RADIUS = 4
"""Default half width of the patch about a corner, px."""

MIN_SHARE = 0.3
"""Smallest share of a patch's pixels that have to have a depth."""

OUTLYING = 4.0
"""Distance from the patch's plane, in robust standard deviations, of pixels that are left out."""

_ROUNDS = 4


def read_depth_picture(
    path: str | os.PathLike[str], unit: str | float = "mm"
) -> Float[np.ndarray, "rows columns"]:
    """Return the depths of a picture of 16 bits, m; NaN where it has none (zero).

    Args:
        path: of a PNG or TIFF file with one channel.
        unit: of its numbers: `"mm"`, `"m"`, or metres by number, such as 0.0001.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: it is no picture of one channel with whole numbers or floats, or an unknown
            unit.
    """
    if isinstance(unit, str) and unit not in LENGTH_UNITS:
        raise ValueError(f"unit: expected {', '.join(LENGTH_UNITS)} or metres, found {unit!r}")
    metres = LENGTH_UNITS[unit] if isinstance(unit, str) else float(unit)
    if not (np.isfinite(metres) and metres > 0.0):
        raise ValueError(f"unit: expected metres above 0, found {unit}")
    content = np.frombuffer(picture_bytes(Path(path)), np.uint8)
    depth = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if len(content) else None
    if depth is None:
        raise ValueError(f"{path}: no readable picture")
    if depth.ndim != 2 or depth.dtype == np.uint8:
        raise ValueError(
            f"{path}: expected depths of one channel with 16 bits, found shape {depth.shape} of "
            f"{depth.dtype}"
        )
    depth = depth.astype(float)
    return np.where(np.isfinite(depth) & (depth > 0.0), metres * depth, np.nan)


def cloud_from_depth(
    depth: Float[np.ndarray, "rows columns"], camera: Camera
) -> Float[np.ndarray, "rows columns 3"]:
    """Return the points of a depth picture in the sensor's frame, m.

    Args:
        depth: distances along the optical axis, m; NaN where there is none.
        camera: of the depth picture, with its lens.

    Raises:
        ValueError: the picture is not of the camera's size.
    """
    rows, columns = depth.shape
    if (columns, rows) != tuple(camera.image_size):
        width, height = camera.image_size
        raise ValueError(
            f"depth: expected {width} x {height} px, as of the camera, found {columns} x {rows}"
        )
    v, u = np.mgrid[:rows, :columns].astype(float)
    pixels = to_device(np.stack([u, v], axis=-1))
    rays, valid = map(np.asarray, camera.unproject(pixels))
    z = np.where(valid & (rays[..., 2] > 1e-3), rays[..., 2], np.nan)
    return rays * (depth / z)[..., None]


def points_at_pixels(
    cloud: np.ndarray, pixels: np.ndarray, radius: int = PATCH_RADIUS
) -> Float[np.ndarray, "points 3"]:
    """Return the points of an organised cloud at some pixels, from the patch about each.

    Args:
        cloud: one point for each pixel of the sensor's picture `(rows, columns, 3)`, m; NaN where
            there is none.
        pixels: corners that were detected in this picture `(points, 2)`, px; NaN where not
            detected.
        radius: half width of the patch, px; smaller than the squares of the target.

    Returns:
        The points; NaN where too few pixels of the patch have a point.

    Raises:
        ValueError: arrays of other shapes, or a radius below 1.

    For example:

        >>> rows, columns = np.mgrid[:40, :60]
        >>> plane = np.stack([0.001 * columns, 0.001 * rows, 0.5 + 0.0001 * columns], axis=-1)
        >>> sv.depth.points_at_pixels(plane, np.array([[30.5, 20.25]])).round(6).tolist()
        [[0.0305, 0.02025, 0.50305]]
    """
    if cloud.ndim != 3 or cloud.shape[2] != 3:
        raise ValueError(f"cloud: expected shape (rows, columns, 3), found {cloud.shape}")
    if pixels.ndim != 2 or pixels.shape[1] != 2:
        raise ValueError(f"pixels: expected shape (points, 2), found {pixels.shape}")
    if radius < 1:
        raise ValueError(f"radius: expected 1 px or more, found {radius}")
    measured = np.full((len(pixels), 3), np.nan)
    for k, (u, v) in enumerate(pixels):
        if not np.isfinite(u + v):
            continue
        left, top = max(0, round(u) - radius), max(0, round(v) - radius)
        # A slice may end beyond the picture.
        right, bottom = max(0, round(u) + radius + 1), max(0, round(v) + radius + 1)
        patch = cloud[top:bottom, left:right]
        y, x = np.mgrid[: patch.shape[0], : patch.shape[1]]
        known = np.isfinite(patch).all(axis=2)
        if known.sum() >= MIN_SHARE * (2 * radius + 1) ** 2:
            offsets = np.column_stack([left + x[known] - u, top + y[known] - v])
            measured[k] = _value_in_the_middle(offsets, patch[known])
    return measured


def _value_in_the_middle(
    offsets: Float[np.ndarray, "pixels 2"], points: Float[np.ndarray, "pixels 3"]
) -> Float[np.ndarray, "3"]:
    """Return the value at offset zero of an affine function of the pixels, fitted robustly."""
    design = np.column_stack([np.ones(len(offsets)), offsets])
    # Medians begin: an edge of another surface may run through the patch.
    values = np.zeros((3, 3))
    values[0] = np.median(points, axis=0)
    for _ in range(_ROUNDS):
        kept = _near(points[:, 2], design, values[:, 2])
        values = np.linalg.lstsq(design[kept], points[kept], rcond=None)[0]
    return values[0]


def _near(
    depths: Float[np.ndarray, "pixels"],
    design: Float[np.ndarray, "pixels _"],
    values: Float[np.ndarray, "_"],
) -> np.ndarray:
    """Return which depths are near a function of the pixels, by their own scatter."""
    off = np.abs(depths - design @ values)
    return off <= OUTLYING * MAD_TO_SIGMA * max(float(np.median(off)), 1e-12)
