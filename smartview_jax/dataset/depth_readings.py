"""Hold the depths that a camera measured at the target's points, with their noise.

A camera with a depth picture that is registered to its other picture (RGB-D, structured light) has
three numbers for a corner: u, v, and the depth along the optical axis. The depths of a rigid
target are an affine function of the points' coordinates on the target, whatever its pose, the lens
and the sensor's scale are. What a view's depths scatter about the best such function is noise, so
it is estimated here, without any calibration.
"""

import dataclasses

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import nnls

from ..runtime.array_namespace import AnyArray, AnyScalar, array_namespace, to_device
from ..runtime.padding import repeat_last

MIN_FREEDOM = 8
"""Smallest number of depths, beyond those that place the target, from which noise is estimated."""

OUTLYING = 5.0
"""Distance from the target's plane, in robust standard deviations, of depths that are left out."""

STEEPEST = 2.0
"""Largest change of depth by metre on the target; above 1 only for a wrong unit or by noise."""

SMALLEST_STD = 1e-6
"""Smallest standard deviation of a depth, m: exact depths count as if they had this noise."""

MAD_TO_SIGMA = 1.4826
"""Ratio of the standard deviation of a normal variable to its median absolute deviation."""

_ROUNDS, _SUBSETS = 20, 100


@dataclasses.dataclass(frozen=True)
class DepthNoise:
    """The standard deviation of depths: of single ones, which grows with the depth z, and by view.

        std(z)^2 = constant^2 + (quadratic z^2)^2

    Stereo and structured light have a quadratic part (0.001 to 0.003 per metre are common), time of
    flight hardly any. Depths of one view also have an error in common, such as the wiggling error
    of time of flight, which no number of points averages.

    Attributes:
        constant: part that does not depend on the depth, m.
        quadratic: standard deviation at 1 m of the part that grows with the square, 1/m.
        common: standard deviation of the error that all depths of a view have in common, m; None
            if it is to be estimated.
    """

    constant: float
    quadratic: float = 0.0
    common: float | None = None

    def __post_init__(self) -> None:
        numbers = np.array([self.constant, self.quadratic])
        if not (np.isfinite(numbers).all() and (numbers >= 0.0).all() and numbers.any()):
            raise ValueError(
                "DepthNoise: expected numbers of at least 0, not both 0; found constant "
                f"{self.constant} and quadratic {self.quadratic}"
            )
        if self.common is not None and not 0.0 <= self.common < np.inf:
            raise ValueError(f"DepthNoise.common: expected 0 or more, found {self.common}")

    def std(self, depth: Float[np.ndarray, "*points"]) -> Float[np.ndarray, "*points"]:
        """Return the standard deviation at depths, m."""
        return np.asarray(_depth_std(depth, self.constant, self.quadratic))


def _depth_std(
    depth: Float[AnyArray, "*points"], constant: AnyScalar, quadratic: AnyScalar
) -> Float[AnyArray, "*points"]:
    """Return the standard deviation at depths, m, by the two parts of `DepthNoise`."""
    xp = array_namespace(depth, constant, quadratic)
    return xp.hypot(constant, quadratic * xp.square(depth))


def depth_precision(
    depth: Float[AnyArray, "*points"], constant: AnyScalar, quadratic: AnyScalar
) -> Float[AnyArray, "*points"]:
    """Return one over the standard deviation at depths, 1/m, by the two parts of `DepthNoise`."""
    std = _depth_std(depth, constant, quadratic)
    return 1.0 / array_namespace(std).maximum(std, SMALLEST_STD)


class DepthReadings(eqx.Module):
    """The depths of a data set's points as arrays, for compiled functions.

    Attributes:
        measured: depths along the camera's optical axis, m; zero where there is none.
        precision: one over their standard deviation, 1/m; zero where there is none, or left out.
        common_std: standard deviation of the error that all depths of a view have in common, m, one
            for each view.
        pixel_sigma: standard deviation of u and of v, px, in fits that take these standard
            deviations as they are: a fit that finds pixels twice as noisy takes depths as twice as
            noisy. Zero until the pixels' noise is known; depths then have no effect.
    """

    measured: Float[AnyArray, "*views points"]
    precision: Float[AnyArray, "*views points"]
    common_std: Float[AnyArray, "*views"]
    pixel_sigma: Float[AnyArray, "*views"]

    @property
    def used(self) -> Bool[np.ndarray, "views points"]:
        """Mask of the depths that count, on the host."""
        return np.asarray(self.precision) > 0.0

    def padded_points(self, count: int) -> "DepthReadings":
        """Return the readings on the host, with points added up to a number."""
        measured, precision = repeat_last(
            (np.asarray(self.measured), np.asarray(self.precision)), count, axis=1
        )
        by_view = np.asarray(self.common_std), np.asarray(self.pixel_sigma)
        return DepthReadings(measured, precision, *by_view)

    def weighed(self, pixel_sigma: float, common_std: float) -> "DepthReadings":
        """Return the readings for fits that take this as the pixels' noise, px.

        Args:
            pixel_sigma: standard deviation of u and of v within a view, px.
            common_std: standard deviation of the depths' common error in a view, m.
        """
        pixel, common = (
            to_device(np.full(np.shape(self.pixel_sigma), value))
            for value in (pixel_sigma, common_std)
        )
        return dataclasses.replace(self, pixel_sigma=pixel, common_std=common)

    @property
    def is_weighed(self) -> bool:
        """Whether the noise of the pixels is known, relative to which the depths count."""
        return bool(np.asarray(self.pixel_sigma).any())


def depth_readings(
    points: Float[np.ndarray, "views points 3"],
    depths: Float[np.ndarray, "views points"],
    visible: Bool[np.ndarray, "views points"],
    noise: DepthNoise | None,
) -> tuple[DepthReadings, DepthNoise]:
    """Return depths with their standard deviations, and the noise that these come from.

    Depths far from the plane through the other depths of the view are left out.

    Args:
        points: points of the target, m.
        depths: measured depths, m; NaN where there is none.
        visible: points that were detected; depths of others are not used.
        noise: the sensor's stated noise; None estimates it.

    Raises:
        ValueError: depths in another unit, or too few to estimate their noise.
    """
    used = visible & np.isfinite(depths)
    fitted = np.where(used, depths, 0.0)
    sums, freedom, middle = (np.zeros(len(depths)) for _ in range(3))
    for view, seen in enumerate(used):
        if seen.any():
            place = _affine_fit(points[view, seen], depths[view, seen])
            fitted[view, seen] = place.fitted
            used[view, seen] = place.kept
            sums[view], freedom[view] = place.sum_of_squares, place.freedom
            middle[view] = float(np.median(place.fitted))
    if noise is None:
        if (count := int(freedom.sum())) < MIN_FREEDOM:
            raise ValueError(
                f"depths: expected {MIN_FREEDOM} or more beyond three a view to estimate their "
                f"noise, found {max(count, 0)}: state it by noise=DepthNoise(...)"
            )
        noise = _likeliest_noise(sums, freedom, middle)
    precision = np.where(used, depth_precision(fitted, noise.constant, noise.quadratic), 0.0)
    unknown = to_device(np.zeros(len(depths)))
    measured = to_device(np.where(used, depths, 0.0))
    return DepthReadings(measured, to_device(precision), unknown, unknown), noise


@dataclasses.dataclass(frozen=True)
class _AffineFit:
    """An affine function of the target's coordinates, fitted to the depths of a view.

    Attributes:
        fitted: its values.
        kept: depths that are near.
        sum_of_squares: of the kept depths' distances, m^2.
        freedom: number of kept depths beyond those that determine the function.
    """

    fitted: Float[np.ndarray, "seen"]
    kept: Bool[np.ndarray, "seen"]
    sum_of_squares: float
    freedom: int


def _affine_fit(
    points: Float[np.ndarray, "seen 3"], depths: Float[np.ndarray, "seen"]
) -> _AffineFit:
    """Fit the depths of a view by an affine function, without those far from the others."""
    design = np.column_stack([np.ones(len(points)), points - points.mean(axis=0)])
    rank = int(np.linalg.matrix_rank(design, rtol=1e-9))
    # Least median of squares (Rousseeuw and Leroy, Robust Regression and Outlier Detection, 1987):
    # of many exact fits to a few depths, the one that is near most of the others.
    chosen = np.random.default_rng(0).random((_SUBSETS, len(depths))).argsort(axis=1)[:, :rank]
    candidates = (np.linalg.pinv(design[chosen], rtol=1e-9) @ depths[chosen][..., None])[..., 0]
    off = np.abs(depths - candidates @ design.T)
    best = np.argmin([_robust_std(offsets, rank) for offsets in off])
    values, kept = candidates[best], np.zeros(len(depths), dtype=bool)
    for _ in range(_ROUNDS):
        off = np.abs(depths - design @ values)
        near = off <= OUTLYING * max(_robust_std(off, rank), SMALLEST_STD)
        if (near == kept).all():
            break
        kept = near
        values = np.linalg.lstsq(design[kept], depths[kept], rcond=1e-9)[0]
    if np.linalg.norm(values[1:]) > STEEPEST:
        raise ValueError(
            "depths: expected to change by at most 1 m by metre on the target, found "
            f"{np.linalg.norm(values[1:]):.3g}; millimetres given as metres?"
        )
    off = depths - design @ values
    freedom = max(int(kept.sum()) - rank, 0)
    return _AffineFit(design @ values, kept, float(np.square(off[kept]).sum()), freedom)


def _robust_std(off: Float[np.ndarray, "seen"], rank: int) -> float:
    """Return the standard deviation that the smaller half of a fit's absolute residuals tells.

    As many residuals as the fit has parameters (the rank) may be zero.
    """
    half = np.sort(off)[min((len(off) + rank) // 2, len(off) - 1)]
    return MAD_TO_SIGMA * float(half)


def _likeliest_noise(
    sums: Float[np.ndarray, "views"],
    freedom: Float[np.ndarray, "views"],
    depth: Float[np.ndarray, "views"],
) -> DepthNoise:
    """Return the noise of the largest restricted likelihood of the views' sums of squares.

    -2 log L = sum over the views of n log s^2 + S / s^2, with n degrees of freedom, sum of squares
    S and s the standard deviation at the view's depth.
    """
    told = freedom > 0
    n, mean_square, design = (
        freedom[told],
        sums[told] / freedom[told],
        np.column_stack([np.ones(told.sum()), depth[told] ** 4]),
    )
    variances = np.full(len(n), sums.sum() / freedom.sum() + SMALLEST_STD**2)
    parts = np.zeros(2)
    for _ in range(_ROUNDS):
        # Fisher scoring: the variance of a mean square is 2 s^4 / n.
        weight = np.sqrt(n) / variances
        scales = np.linalg.norm(weight[:, None] * design, axis=0)
        parts = nnls(weight[:, None] * design / scales, weight * mean_square)[0] / scales
        variances = np.maximum(design @ parts, SMALLEST_STD**2)
    constant, quadratic = np.sqrt(parts)
    return DepthNoise(max(float(constant), 0.0 if quadratic else SMALLEST_STD), float(quadratic))
