"""Describe how corners look, so that corners of different views can be compared.

A patch around each corner is sampled along directions that are the same in the world for all views,
and through the lens: neither a roll of the camera nor the distortion at the picture's border
changes it. The foreshortening of a slanted surface remains.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from ..cameras import Camera
from .features import Features
from .ideal_plane import IdealPlane
from .picture_checks import grey_levels

PATCH_RADIUS = 5
"""Samples of a patch from its centre to its border, in each direction."""

PATCH_STEP = 1.4
"""Distance between the samples of a patch, px of the undistorted picture."""

PATCH_SMOOTHING = 1.0
"""Standard deviation of the smoothing before patches are sampled, px."""

MIN_PATCH_CONTRAST = 1.0
"""Standard deviation of a patch's grey levels below which it is taken as without contrast."""


class Appearance(NamedTuple):
    """The appearance of the corners of one picture.

    Attributes:
        patches: grey levels with mean zero and unit length, so that the product of two patches is
            their normalised correlation. Zero for a patch without contrast or outside the picture.
        directions: angles of the segments that meet in each corner, rad, in the patches' frame,
            padded with NaN.
    """

    patches: Float[np.ndarray, "corners samples"]
    directions: Float[np.ndarray, "corners joined"]


def describe(
    picture: np.ndarray,
    camera: Camera,
    features: Features,
    reference: Float[np.ndarray, "3"],
) -> Appearance:
    """Return the appearance of a picture's corners.

    Args:
        reference: direction in the camera's frame, of any length, for the patches' first axis; the
            same direction of the world for all views that are compared, roughly perpendicular to
            the line of sight.

    Raises:
        ValueError: the picture does not fit the camera, as for `find`.
    """
    plane = IdealPlane(camera)
    smooth = cv2.GaussianBlur(grey_levels(picture, camera), (0, 0), PATCH_SMOOTHING)
    axes = _patch_axes(plane, features.corners, reference)
    patches = _sampled_patches(smooth.astype(np.float32), features.corners, axes)
    return Appearance(patches, _joined_directions(features, axes))


def _patch_axes(
    plane: IdealPlane, corners: Float[np.ndarray, "corners 2"], reference: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "corners 2 2"]:
    """Return the steps of the patches' axes in pixels, as matrix columns."""
    ideal = plane.from_pixels(corners)
    rays = plane.rays(ideal)
    # Both axes are perpendicular to the ray, the first as near as possible to the reference.
    across = reference - rays * (rays @ reference)[:, None]
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    down = np.cross(rays, across)
    x, y, z = rays.T
    # A step s of the ray moves (x / z, y / z) by (s_x - x / z s_z, s_y - y / z s_z) / z; the lens's
    # derivative turns this into pixels. Steps are in units of 1 / f, which are pixels.
    slopes = np.stack([x / z, y / z], axis=1)
    by_ideal = plane.to_pixels(ideal)[1]
    steps = [
        np.einsum("nij,nj->ni", by_ideal, (s[:, :2] - slopes * s[:, 2:]) / z[:, None])
        for s in (across, down)
    ]
    return np.stack(steps, axis=-1)


def _sampled_patches(
    picture: Float[np.ndarray, "rows columns"],
    corners: Float[np.ndarray, "corners 2"],
    axes: Float[np.ndarray, "corners 2 2"],
) -> Float[np.ndarray, "corners samples"]:
    """Return patches with mean zero and unit length."""
    reach = PATCH_STEP * np.arange(-PATCH_RADIUS, PATCH_RADIUS + 1)
    grid = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    samples = corners[:, None] + np.einsum("nij,sj->nsi", axes, grid)
    levels = np.empty(samples.shape[:2])
    # OpenCV's remap takes at most 32767 rows.
    for start in range(0, len(samples), 30_000):
        part = samples[start : start + 30_000].astype(np.float32)
        levels[start : start + 30_000] = cv2.remap(
            picture, part[..., 0], part[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
    # The centre of a patch counts more than its border, where other surfaces may begin.
    weights = np.exp(-0.5 * (grid**2).sum(axis=1) / (0.7 * reach[-1]) ** 2)
    weights /= weights.sum()
    levels -= (levels @ weights)[:, None]
    contrast = np.sqrt(levels**2 @ weights)
    usable = contrast > MIN_PATCH_CONTRAST
    scale = np.where(usable, 1.0 / np.where(usable, contrast, 1.0), 0.0)
    return levels * np.sqrt(weights) * scale[:, None]


def _joined_directions(
    features: Features, axes: Float[np.ndarray, "corners 2 2"]
) -> Float[np.ndarray, "corners joined"]:
    """Return the angles of the segments that meet in each corner, in the patches' frame."""
    joined = features.corner_segments
    angles = np.full(joined.shape, np.nan)
    corner, column = np.nonzero(joined >= 0)
    ends = features.segments[joined[corner, column]] - features.corners[corner, None]
    # From the corner to the segment's farther end.
    far = np.argmax(np.linalg.norm(ends, axis=2), axis=1)
    pixels = ends[np.arange(len(far)), far]
    local = np.linalg.solve(axes[corner], pixels[..., None])[..., 0]
    angles[corner, column] = np.arctan2(local[:, 1], local[:, 0])
    return angles
