"""Draw the curve on which a pixel of one view appears in another, with the real lens.

A pixel is a ray in space. With distortion the picture of the ray in another view is a curve;
without, a straight line. Every point of the curve has a depth along the ray, so that a curve also
gives the depths that are compatible with a pixel near it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...cameras import AnyCamera, unit_rays
from ...robots import CommandLike
from ...runtime.array_namespace import to_device
from ...runtime.compilation import compiled
from ...runtime.padding import repeat_last
from ..rig_views import AnyCalibration, RigViews, calibration_of_views
from ..view_poses import SeenViews, single_pose

SAMPLES = 128
"""Number of points of a curve. In a picture of 4000 px they are 30 px apart, so that a curve with
the picture's size as its radius is drawn to 0.03 px."""

REFINEMENTS = 3
"""Number of times that the samples are placed again, to spread evenly within the picture."""


class EpipolarCurve(NamedTuple):
    """The picture of a ray in another view, as a polyline cut at the picture's border.

    It has several pieces where it leaves the picture and returns, and none where the view does not
    see the ray.

    Attributes:
        pixels: points of the polyline, px.
        depths: distance of each from the first camera's centre along its ray, m; may be infinite.
        piece: number of the connected piece that each belongs to, ascending.
        origin: centre of the first camera in the world, m.
        direction: unit direction of the ray in the world.
    """

    pixels: Float[np.ndarray, "samples 2"]
    depths: Float[np.ndarray, "samples"]
    piece: Int[np.ndarray, "samples"]
    origin: Float[np.ndarray, "3"]
    direction: Float[np.ndarray, "3"]


def epipolar_curve(
    calibration: AnyCalibration,
    pose_a: CommandLike,
    pixel: Float[np.ndarray, "2"] | Sequence[float],
    pose_b: CommandLike,
    depths: tuple[float, float],
) -> EpipolarCurve:
    """Return the curve of a pixel of view a in view b; arguments as in `epipolar_curves`."""
    return epipolar_curves(calibration, pose_a, pixel, single_pose(pose_b), depths)[0]


def epipolar_curves(
    calibration: AnyCalibration,
    pose_a: CommandLike,
    pixel: Float[np.ndarray, "2"] | Sequence[float],
    poses_b: CommandLike,
    depths: tuple[float, float],
) -> list[EpipolarCurve]:
    """Return the curves of a pixel of view a in several views b.

    Args:
        calibration: the calibrated camera; or `RigViews` that name the camera of view a first, then
            of each other view.
        pose_a: pose that the robot reported in view a, one `base_from_tool` or `Command`.
        pixel: in view a, px.
        poses_b: reported poses of the views b.
        depths: smallest and largest distance from the camera along the ray, m; the largest may be
            infinite.

    Raises:
        ValueError: a pixel outside the picture or the lens, or wrong depths.
    """
    near, far = map(float, depths)
    if not 0.0 < near < far:
        raise ValueError(f"depths: expected 0 < nearest < farthest, found {near:g} and {far:g}")
    first = SeenViews.of(calibration_of_views(calibration, [0]), single_pose(pose_a))
    later = calibration
    if isinstance(calibration, RigViews):
        later = calibration.of_views(range(1, len(calibration)))
    others = SeenViews.of(later, poses_b)
    given = np.asarray(pixel, dtype=float)
    first.checked_points(given[None, None], None)
    origin, direction = _ray(first, given)
    views = len(others.camera_from_world)
    sizes = [camera.image_size for camera in others.cameras]
    # Pictures change about evenly with inverse depth, and infinity is zero.
    inverse = np.tile(np.linspace(1.0 / near, 1.0 / far, SAMPLES), (views, 1))
    for _ in range(REFINEMENTS):
        pixels, valid = _project(others, origin, direction, inverse)
        inverse = np.stack(
            [_evenly_within(*view) for view in zip(inverse, pixels, valid, sizes, strict=True)]
        )
    pixels, valid = _project(others, origin, direction, inverse)
    return [
        EpipolarCurve(*_cut(inverse[k], pixels[k], valid[k], sizes[k]), origin, direction)
        for k in range(views)
    ]


def _ray(
    view: SeenViews, pixel: Float[np.ndarray, "2"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return the camera's centre and the unit ray of a pixel in the world."""
    # The ray in the world is R^T times the ray in the camera.
    ray, valid = map(np.asarray, unit_rays(view.cameras[0], to_device(pixel)))
    if not valid:
        raise ValueError(f"pixel: {pixel.tolist()} px is outside the range of the lens model")
    return view.centres[0], view.camera_from_world[0, :3, :3].T @ ray


def _project(
    views: SeenViews,
    origin: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "3"],
    inverse: Float[np.ndarray, "views samples"],
) -> tuple[Float[np.ndarray, "views samples 2"], Bool[np.ndarray, "views samples"]]:
    """Return the pixels of the ray's points at each view's inverse depths."""
    # Padded views repeat the last one, with its depths.
    padded = repeat_last(inverse, len(views.padded))
    ray = np.stack([origin, direction])
    pixels, valid = _project_ray(
        views.camera_for(len(padded)), to_device(views.padded), to_device(ray), to_device(padded)
    )
    return np.asarray(pixels)[: len(inverse)], np.asarray(valid)[: len(inverse)]


@compiled
def _project_ray(
    camera: AnyCamera,
    camera_from_world: Float[Array, "views 4 4"],
    ray: Float[Array, "2 3"],
    inverse: Float[Array, "views samples"],
) -> tuple[Float[Array, "views samples 2"], Bool[Array, "views samples"]]:
    """Return pixels of points of a ray; behind a camera or outside its lens they are not valid."""
    # The direction of o + d / s from the camera is s (R o + t) + R d for s > 0: finite at s = 0,
    # the point at infinity.
    rotation, translation = camera_from_world[:, :3, :3], camera_from_world[:, :3, 3]
    origin = jnp.einsum("vij,j->vi", rotation, ray[0]) + translation
    direction = jnp.einsum("vij,j->vi", rotation, ray[1])
    return camera.project(inverse[..., None] * origin[:, None] + direction[:, None])


def _clip(
    pixels: Float[np.ndarray, "samples 2"],
    valid: Bool[np.ndarray, "samples"],
    size: tuple[int, int],
) -> tuple[Float[np.ndarray, "segments"], Float[np.ndarray, "segments"]]:
    """Return where each segment of a polyline enters and leaves the picture, as fractions of it.

    A segment that does not cross the picture leaves it before it enters.

    Reference: Liang and Barsky, A new concept and method for line clipping, 1984.
    """
    joined = valid[1:] & valid[:-1]
    start = np.where(joined[:, None], pixels[:-1], 0.0)
    along = np.where(joined[:, None], pixels[1:] - start, 0.0)
    low, high = np.full(2, -0.5), np.array(size) - 0.5
    with np.errstate(divide="ignore", invalid="ignore"):
        crossings = np.sort(np.stack([(low - start) / along, (high - start) / along]), axis=0)
    # A segment parallel to a border is between the borders everywhere, or nowhere.
    level = along == 0.0
    between = (start >= low) & (start <= high)
    enter = np.where(level, np.where(between, 0.0, np.inf), crossings[0]).max(axis=1)
    leave = np.where(level, np.where(between, 1.0, -np.inf), crossings[1]).min(axis=1)
    enter, leave = np.maximum(enter, 0.0), np.minimum(leave, 1.0)
    return np.where(joined, enter, 1.0), np.where(joined, leave, 0.0)


def _evenly_within(
    inverse: Float[np.ndarray, "samples"],
    pixels: Float[np.ndarray, "samples 2"],
    valid: Bool[np.ndarray, "samples"],
    size: tuple[int, int],
) -> Float[np.ndarray, "samples"]:
    """Return inverse depths whose points are evenly spaced along the curve within the picture."""
    enter, leave = _clip(pixels, valid, size)
    crossing = leave > enter
    if not crossing.any():
        return inverse
    # Cumulative length over the segments within the picture, inverted at even steps.
    length = np.linalg.norm(np.diff(pixels, axis=0)[crossing], axis=1)
    visible_length = length * (leave - enter)[crossing]
    change = np.diff(inverse)[crossing]
    start, step = inverse[:-1][crossing] + enter[crossing] * change, (leave - enter)[crossing]
    # Each segment gets samples in proportion to its length; both ends are kept.
    ends = np.concatenate([[0.0], np.cumsum(np.maximum(visible_length, 1e-12))])
    targets = np.linspace(0.0, ends[-1], len(inverse))
    k = np.clip(np.searchsorted(ends, targets, side="right") - 1, 0, len(length) - 1)
    part = (targets - ends[k]) / (ends[k + 1] - ends[k])
    return start[k] + np.clip(part, 0.0, 1.0) * (step * change)[k]


def _cut(
    inverse: Float[np.ndarray, "samples"],
    pixels: Float[np.ndarray, "samples 2"],
    valid: Bool[np.ndarray, "samples"],
    size: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixels, depths and piece numbers of the polyline within the picture."""
    enter, leave = _clip(pixels, valid, size)
    crossing = np.flatnonzero(leave > enter)
    cut: list[tuple[np.ndarray, float, int]] = []
    piece, last = -1, None
    # A segment continues the last piece if that one ended, uncut, where this one begins.
    for k in crossing:
        along, change = pixels[k + 1] - pixels[k], inverse[k + 1] - inverse[k]
        continues = last == k - 1 and enter[k] == 0.0 and leave[k - 1] == 1.0
        if not continues:
            piece += 1
            cut.append((pixels[k] + enter[k] * along, inverse[k] + enter[k] * change, piece))
        cut.append((pixels[k] + leave[k] * along, inverse[k] + leave[k] * change, piece))
        last = k
    if not cut:
        return np.zeros((0, 2)), np.zeros(0), np.zeros(0, dtype=int)
    points, inverses, numbers = zip(*cut, strict=True)
    with np.errstate(divide="ignore"):
        return np.array(points), 1.0 / np.array(inverses), np.array(numbers)
