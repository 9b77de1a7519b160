"""Test a detection against the target's geometry before it is used for a calibration.

Detectors may return wrong points without any warning: a corner of the board's outline or of another
square, a row counted twice, tags with another border. No camera can see the target's points in such
positions. Two tests decide:

- A camera with any symmetric lens is fitted to the picture (`fit_symmetric_lens`). The residuals
  must be as small as the noise of a sub-pixel detector.
- If this test fails, each point is compared with a smooth map from target to picture through its
  ring of neighbours. This test assumes no lens, so it accepts a lens without an axis or a bent
  board, but it needs a target of many points.

A single point fails if its position is better explained by a wrong point, uniformly distributed
over its cell of the target, than by noise. A picture fails if its noise is too large or too many
points fail.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from ..cameras import MIN_LENS_POINTS, fit_symmetric_lens, spanned_coordinates
from .detection import Detection, empty_detection

_RAYLEIGH_MEDIAN = float(np.sqrt(2.0 * np.log(2.0)))
"""Median length of a plane vector whose components have unit standard deviation."""

_CELL_STD = 1.0 / np.sqrt(12.0)
"""Standard deviation of a point distributed uniformly over its cell, in widths of the cell."""

_LEAST_SPACING = 2.0
"""Least distance between neighbours, px; nearer edges merge in a picture."""

_MAX_ROUNDS = 6
"""Number of fits, each without the points that failed in the previous fit."""


@dataclasses.dataclass(frozen=True)
class DetectionLimits:
    """Limits on the distances of detected points from the positions that the other points predict.

    Attributes:
        noise: largest standard deviation of a detection that counts as good, px; OpenCV's
            sub-pixel detectors have 0.05 to 0.35 px on real pictures.
        largest_noise: standard deviation above which a picture is refused, px; no sub-pixel
            detector is as bad if it has found the right points.
        spacing_share: standard deviation as a fraction of the distance between neighbours, which is
            added to both: in large or blurred pictures, and on paper that is not quite flat, noise
            grows with the size of a square.
        smooth_share: residual of a smooth map through a ring of neighbours, as a fraction of the
            distance between neighbours, for lenses of up to 100 degrees off the axis.
        wrong_points: prior probability that a detected point is wrong.
        left_out: largest fraction of a picture's points that may be left out as wrong; with more,
            the remaining points need not be right either.
        ring: number of neighbours with which a point is compared.
        ring_lines: smallest number of rows and columns of points for the test by rings alone; a
            smooth map fits three lines of points exactly, wherever they are.
    """

    noise: float = 0.5
    largest_noise: float = 1.0
    spacing_share: float = 0.01
    smooth_share: float = 0.02
    wrong_points: float = 1e-3
    left_out: float = 0.25
    ring: int = 24
    ring_lines: int = 5

    def __post_init__(self) -> None:
        """Raise a ValueError that names the first limit that is not positive."""
        for name, value in dataclasses.asdict(self).items():
            if not 0.0 < value < float("inf"):
                raise ValueError(f"{name}: expected a positive number, found {value!r}")
        if self.wrong_points >= 0.5 or self.left_out >= 0.5:
            raise ValueError("wrong_points, left_out: expected less than half of the points")

    def good_noise(self, spacing: float) -> float:
        """Return the largest standard deviation of a good detection, px."""
        return float(np.hypot(self.noise, self.spacing_share * spacing))

    def largest(self, spacing: float) -> float:
        """Return the standard deviation above which a picture is refused, px."""
        # In a very small picture, where limits in pixels mean little, the limit is a third of the
        # standard deviation of points distributed uniformly over their cells.
        limit = float(np.hypot(self.largest_noise, self.spacing_share * spacing))
        return min(limit, _CELL_STD * spacing / 3.0)

    def distance(self, std: float | np.ndarray, spacing: np.ndarray) -> np.ndarray:
        """Return the distance above which a point is likelier wrong than right, px.

        Args:
            std: standard deviation of a right point along each axis, px.
            spacing: distance between neighbours, px, the side of the square over which wrong points
                are distributed uniformly.
        """
        # (1 - w) exp(-d^2 / (2 std^2)) / (2 pi std^2)  =  w / spacing^2
        ratio = (1.0 - self.wrong_points) / self.wrong_points * spacing**2 / (2.0 * np.pi * std**2)
        return std * np.sqrt(2.0 * np.log(np.maximum(ratio, 1.0)))


class PointTest(NamedTuple):
    """The result of testing one picture's points.

    Attributes:
        passed: whether each point is near its expected position.
        noise: standard deviation of the points that passed, px.
        reason: the reason why the whole picture fails; None if it passes.
    """

    passed: Bool[np.ndarray, "points"]
    noise: float
    reason: str | None


def check_points(
    points: Float[np.ndarray, "points 3"],
    pixels: Float[np.ndarray, "points 2"],
    image_size: tuple[int, int],
    limits: DetectionLimits | None = None,
) -> PointTest:
    """Test the points that were detected in one picture against each other.

    Args:
        points: the target's points that were detected, m.
        pixels: one for each point, px.
        image_size: width and height, px.
        limits: by default `DetectionLimits()`.

    Returns:
        The result; if there are too few points for a test, all of them pass.
    """
    limits = limits or DetectionLimits()
    spacing = _spacing(points, pixels)
    if len(points) >= MIN_LENS_POINTS and np.median(spacing) < _LEAST_SPACING:
        reason = f"its points are only {np.median(spacing):.2g} px apart, too near for a detector"
        return PointTest(np.zeros(len(points), dtype=bool), 0.0, reason)
    by_camera = _by_camera(points, pixels, image_size, spacing, limits)
    if by_camera is None or by_camera.reason is None:
        return by_camera or PointTest(np.ones(len(points), dtype=bool), 0.0, None)
    by_rings = _by_rings(points, pixels, spacing, limits)
    return by_camera if by_rings is None or by_rings.reason else by_rings


def checked_detection(
    detection: Detection,
    points: Float[np.ndarray, "points 3"],
    image_size: tuple[int, int],
    limits: DetectionLimits | None = None,
) -> Detection:
    """Return a detection without the points that fail, or an empty one with the reason."""
    visible = detection.visible
    if not visible.any():
        return detection
    test = check_points(points[visible], detection.pixels[visible], image_size, limits)
    if test.reason is not None:
        return empty_detection(len(points), test.reason)
    passed = visible.copy()
    passed[visible] = test.passed
    pixels = np.where(passed[:, None], detection.pixels, np.nan)
    return detection._replace(
        pixels=pixels,
        visible=passed,
        noise=test.noise,
        left_out=int(np.count_nonzero(~test.passed)),
    )


def checked_pixels(
    points: Float[np.ndarray, "..."],
    pixels: Float[np.ndarray, "views points 2"],
    view_ids: Sequence[str],
    image_size: tuple[int, int],
    limits: DetectionLimits | None = None,
) -> tuple[Float[np.ndarray, "views points 2"], dict[str, str], tuple[str, ...]]:
    """Test detections of another program; points that fail become NaN.

    Args:
        points: points of the target, one set for all views `(points, 3)` or one for each, m.
        pixels: detected points, px; NaN where a point was not detected.
        image_size: width and height, px.
        limits: by default `DetectionLimits()`.

    Returns:
        The pixels, the reason by view id for views that fail, and sentences about points left out.
    """
    tested, failed, left_out = pixels.copy(), {}, {}
    for k, view in enumerate(view_ids):
        is_detected = np.asarray(np.isfinite(pixels[k]).all(axis=1))
        view_points = points if points.ndim == 2 else points[k]
        if not is_detected.any() or not np.isfinite(view_points[is_detected]).all():
            continue
        test = check_points(view_points[is_detected], pixels[k][is_detected], image_size, limits)
        if test.reason is not None:
            failed[view] = test.reason
            tested[k] = np.nan
        elif not test.passed.all():
            left_out[view] = int(np.count_nonzero(~test.passed))
            tested[k, np.flatnonzero(is_detected)[~test.passed]] = np.nan
    return tested, failed, left_out_note(left_out)


def left_out_note(left_out: dict[str, int]) -> tuple[str, ...]:
    """Return a sentence about the points left out and their views; empty if there are none."""
    if not left_out:
        return ()
    views = ", ".join(list(left_out)[:5]) + (", ..." if len(left_out) > 5 else "")
    return (
        "detected points left out because they do not match the target's other points: "
        f"{sum(left_out.values())} (views {views})",
    )


def _spacing(points: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return the distance in the picture from each point to its nearest neighbour, px."""
    if len(points) < 2:
        return np.ones(len(points))
    nearest = np.asarray(KDTree(points).query(points, k=2)[1])
    # A point that is given twice has a distance of zero.
    neighbour = np.where(nearest[:, 1] == np.arange(len(points)), nearest[:, 0], nearest[:, 1])
    return np.maximum(np.linalg.norm(pixels - pixels[neighbour], axis=1), 1e-3)


def _by_camera(
    points: np.ndarray,
    pixels: np.ndarray,
    image_size: tuple[int, int],
    spacing: np.ndarray,
    limits: DetectionLimits,
) -> PointTest | None:
    """Test points against a camera fitted to them; None if they do not determine a camera."""
    usual_spacing = float(np.median(spacing))
    good = limits.good_noise(usual_spacing)
    every_point = np.ones(len(points), dtype=bool)
    # The linear solution is enough for nearly all good detections, and takes a tenth of the time.
    linear = fit_symmetric_lens(points, pixels, image_size, every_point, good, refine=False)
    if linear is None:
        return None
    noise = _noise(linear.residuals, linear.parameter_count)
    distances = np.linalg.norm(linear.residuals, axis=1)
    if noise <= good and (distances <= limits.distance(good, spacing)).all():
        return PointTest(every_point, noise, None)
    passed = every_point
    for _ in range(_MAX_ROUNDS):
        fit = fit_symmetric_lens(points, pixels, image_size, passed, good)
        if fit is None:
            break
        distances = np.linalg.norm(fit.residuals, axis=1)
        noise = _noise(fit.residuals[passed], fit.parameter_count)
        near = distances <= limits.distance(max(noise, good), spacing)
        if np.array_equal(near, passed) or not near.any():
            passed = near
            break
        passed = near
    return _judged(passed, noise, distances, spacing, limits)


def _by_rings(
    points: np.ndarray, pixels: np.ndarray, spacing: np.ndarray, limits: DetectionLimits
) -> PointTest | None:
    """Test points against their neighbours; None if the target is too small for that."""
    coordinates = spanned_coordinates(points)
    if coordinates.shape[1] != 2 or len(points) <= limits.ring_lines:
        return None
    step = np.median(np.asarray(KDTree(coordinates).query(coordinates, k=2)[0])[:, 1])
    # 1.01 instead of 1, because distances are rounded.
    if np.ptp(coordinates, axis=0).min() < (limits.ring_lines - 1.01) * step:
        return None
    every_point = np.ones(len(points), dtype=bool)
    residuals = _ring_residuals(coordinates, pixels, limits.ring)
    noise = _noise(residuals, 0)
    distances = np.linalg.norm(residuals, axis=1)
    std = np.hypot(limits.noise, limits.smooth_share * spacing)
    # Points are not left out one by one, because a wrong point spoils the rings of its neighbours.
    near = distances <= limits.distance(std, spacing)
    return _judged(every_point if near.all() else near, noise, distances, spacing, limits)


def _ring_residuals(
    coordinates: Float[np.ndarray, "points 2"], pixels: Float[np.ndarray, "points 2"], ring: int
) -> Float[np.ndarray, "points 2"]:
    """Return measured minus expected pixels, scaled to the noise of a single point, px.

    The expected pixel is the value at the point of the quadratic polynomial through its neighbours.
    """
    distances, neighbours = KDTree(coordinates).query(
        coordinates, k=min(ring + 1, len(coordinates))
    )
    neighbours = np.asarray(neighbours)[:, 1:]
    offsets = coordinates[neighbours] - coordinates[:, None]
    offsets /= np.maximum(np.asarray(distances)[:, -1:, None], 1e-300)
    u, v = np.moveaxis(offsets, -1, 0)
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
    # The polynomial's value at the point itself is its first coefficient.
    weights = np.linalg.pinv(terms)[:, 0]
    expected = np.einsum("nk,nkc->nc", weights, pixels[neighbours])
    # With equal noise in all points,  var(measured - expected) = (1 + |weights|^2) var.
    return (pixels - expected) / np.sqrt(1.0 + np.sum(weights**2, axis=1))[:, None]


def _noise(residuals: Float[np.ndarray, "points 2"], parameter_count: int) -> float:
    """Return the standard deviation of residuals along each axis, from their median length, px."""
    freedom = max(2 * len(residuals) - parameter_count, 1) / (2 * len(residuals))
    length = float(np.median(np.linalg.norm(residuals, axis=1)))
    return length / _RAYLEIGH_MEDIAN / float(np.sqrt(freedom))


def _judged(
    passed: np.ndarray,
    noise: float,
    distances: np.ndarray,
    spacing: np.ndarray,
    limits: DetectionLimits,
) -> PointTest:
    """Return the result, with a reason if the noise is too large or too many points fail."""
    usual_spacing = float(np.median(spacing))
    wrong = np.count_nonzero(~passed)
    if noise <= limits.largest(usual_spacing) and wrong <= limits.left_out * len(passed):
        return PointTest(passed, noise, None)
    typical, farthest = float(np.median(distances)), int(np.argmax(distances))
    points = f"{wrong} of its points are" if 0 < wrong < len(passed) else "its points are"
    return PointTest(
        passed,
        noise,
        f"the points found do not match this target: {points} up to {distances[farthest]:.2g} px "
        f"({distances[farthest] / spacing[farthest]:.2g} of their spacing) from the positions "
        f"expected from the others; the median is {typical:.2g} px ({typical / usual_spacing:.2g})",
    )
