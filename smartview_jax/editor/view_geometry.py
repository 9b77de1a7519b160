"""Answer the editor's geometric questions for a fixed set of views.

Points are triangulated from clicks and predicted in every view with an error ellipse; pixels are
drawn as epipolar curves in the other views. Results are kept.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypedDict

import numpy as np
from jaxtyping import Bool, Float

from ..engine import covariance_factor
from ..evaluation import CalibrationEstimate
from ..modeling import (
    AbstractConstraint,
    AnyCalibration,
    ConstraintVerdict,
    EpipolarCurve,
    ModelObservations,
    RefinedFeatures,
    SeenViews,
    TriangulatedPoints,
    calibration_of_views,
    command_at,
    epipolar_curves,
    pixel_jacobians,
    refine,
    suspect_clicks,
    triangulate_points,
    wrong_correspondences,
)
from ..robots import Command
from .document import Clicks

DEPTH_RANGE = (0.3, 3.0)
"""Depths along a curve, relative to the distance from the camera to the views' common point."""

MAX_DEPTH_SCALE = 100.0
"""Largest distance to the common point relative to the distance between the views.

Beyond it the optical axes are nearly parallel, and the point is meaningless.
"""

CLICK_FALSE_ALARM = 1e-3
"""Probability that a right click is said to contradict the others of its point.

It holds for each click alone, so that a verdict does not depend on which others are computed.
"""


class _Errors(TypedDict):
    """The uncertainties of the calibration and of clicks, as keyword arguments."""

    covariance: CalibrationEstimate | None
    pixel_sigma: float


class DoubtedClick(NamedTuple):
    """A click that contradicts the other clicks of its point.

    Attributes:
        distance: distance from the point as seen by the other views, px; NaN for two views.
        instead: names of the views whose click may be the wrong one instead.
    """

    distance: float
    instead: tuple[str, ...]

    def __str__(self) -> str:
        others = ", ".join(self.instead)
        if not np.isfinite(self.distance):
            return (
                f"contradicts the click in {others}; with two clicks nobody can tell which is "
                "wrong: click the point in a third view"
            )
        away = f"{self.distance:.1f} px from where the other views see the point"
        return f"{away}, or the click in {others} is wrong" if others else away


class PointEstimate(NamedTuple):
    """The estimate of a clicked point, in space and in every view.

    Attributes:
        position: position in the world, m; NaN if it could not be triangulated.
        picture_covariance: covariance due to the clicks, m^2.
        calibration_factor: movement for one standard deviation of each independent error of the
            calibration, m.
        predicted: predicted pixel in every view.
        ellipses: covariance of the predicted pixel in every view, px^2.
        visible: whether the predicted pixel is within each picture.
        residuals: clicked minus predicted pixel by the view's name.
        wrong_clicks: clicks that contradict those in the other views, by the view's name.
        widening: standard deviation of its clicks over the stated one; above 1 if they contradict
            each other.
        failure: why it has no position; empty if it has one.
    """

    position: Float[np.ndarray, "3"]
    picture_covariance: Float[np.ndarray, "3 3"]
    calibration_factor: Float[np.ndarray, "3 errors"]
    predicted: Float[np.ndarray, "views 2"]
    ellipses: Float[np.ndarray, "views 2 2"]
    visible: Bool[np.ndarray, "views"]
    residuals: Mapping[str, tuple[float, float]]
    wrong_clicks: Mapping[str, DoubtedClick]
    widening: float
    failure: str

    @property
    def nominal_picture_covariance(self) -> Float[np.ndarray, "3 3"]:
        """The covariance due to clicks that are as accurate as stated, m^2; to judge them by."""
        return self.picture_covariance / self.widening**2

    @property
    def covariance(self) -> Float[np.ndarray, "3 3"]:
        """The covariance due to clicks and calibration, m^2."""
        return self.picture_covariance + self.calibration_factor @ self.calibration_factor.T


class ViewGeometry:
    """The views of a session with their cameras' poses.

    Attributes:
        camera_from_world: extrinsics of all views.
        centres: camera centres in the world, m.
        depth_range: nearest and farthest depth of curves by view, m.
        click_sigma: standard deviation of u and of v of a click, px.
    """

    def __init__(
        self,
        calibration: AnyCalibration,
        command: Command,
        names: Sequence[str],
        covariance: CalibrationEstimate | None = None,
        click_sigma: float = 0.5,
    ):
        """Compute the poses of the cameras; the arguments are as in `ModelSession`, checked."""
        self._calibration = calibration
        self.command: Command = command
        self.names: list[str] = list(names)
        self.click_sigma: float = click_sigma
        self._errors: _Errors = {"covariance": covariance, "pixel_sigma": click_sigma}
        self._seen = SeenViews.of(calibration, self.command)
        self._estimates: dict[tuple, PointEstimate] = {}
        # The clicks are kept with their estimate, so that their `id` is not reused.
        self._known: dict[int, tuple[Clicks, PointEstimate]] = {}
        self.camera_from_world: Float[np.ndarray, "views 4 4"] = self._seen.camera_from_world
        self.centres: Float[np.ndarray, "views 3"] = self._seen.centres
        self.depth_range: list[tuple[float, float]] = _depth_range(
            self.camera_from_world, self.centres
        )

    def estimates(self, points: Sequence[Clicks]) -> list[PointEstimate]:
        """Return the estimates of points from their clicks in one or more views."""
        # Documents share the clicks of points that a change left alone, so identical clicks mean
        # the same estimate; comparing a thousand points by value would take too long.
        unknown = [clicks for clicks in points if id(clicks) not in self._known]
        if unknown:
            # By value too, because undo and redo create equal clicks as new objects.
            keys = [tuple(sorted(clicks.items())) for clicks in unknown]
            new = list(dict.fromkeys(key for key in keys if key not in self._estimates))
            if new:
                computed = self._computed([dict(key) for key in new])
                self._estimates.update(zip(new, computed, strict=True))
            for key, clicks in zip(keys, unknown, strict=True):
                self._known[id(clicks)] = (clicks, self._estimates[key])
        return [self._known[id(clicks)][1] for clicks in points]

    def _computed(self, points: Sequence[Clicks]) -> list[PointEstimate]:
        """Return the estimates of points, all in one program."""
        pixels = self._clicked_pixels(points)
        triangulated = triangulate_points(self._calibration, self.command, pixels, **self._errors)
        wrong_clicks = self._wrong_clicks(pixels)
        widening = self._widening(triangulated.residuals, wrong_clicks)
        covariance = widening[:, None, None] ** 2 * triangulated.picture_covariance
        widened = dataclasses.replace(triangulated, picture_covariance=covariance)
        return self._estimates_from(widened, points, wrong_clicks, widening)

    def _widening(
        self,
        residuals: Float[np.ndarray, "views points 2"],
        wrong_clicks: Sequence[Mapping[str, DoubtedClick]],
    ) -> Float[np.ndarray, "points"]:
        """Return the standard deviation of each point's clicks over the stated one.

        Nobody knows for sure which of contradictory clicks is wrong. Their standard deviation is
        then estimated from their residuals (Birge's ratio), and the point is as uncertain.
        """
        sums, counts = np.nansum(residuals**2, axis=(0, 2)), np.isfinite(residuals).sum(axis=(0, 2))
        # A point has three coordinates.
        scatter = np.sqrt(sums / np.maximum(counts - 3, 1))
        contradict = np.array([bool(wrong) for wrong in wrong_clicks], dtype=bool)
        return np.where(contradict, np.maximum(scatter / self.click_sigma, 1.0), 1.0)

    def _wrong_clicks(
        self, pixels: Float[np.ndarray, "views points 2"]
    ) -> list[dict[str, DoubtedClick]]:
        """Return the clicks that contradict the others of their point, by point and view."""
        wrong: list[dict[str, DoubtedClick]] = [{} for _ in range(pixels.shape[1])]
        clicks = int(np.isfinite(pixels[..., 0]).sum())
        for click in wrong_correspondences(
            self._calibration,
            self.command,
            pixels,
            false_alarm=CLICK_FALSE_ALARM * clicks,
            **self._errors,
        ):
            others = tuple(self.names[view] for view in click.instead)
            wrong[click.feature][self.names[click.view]] = DoubtedClick(click.distance, others)
        return wrong

    def suspects(
        self,
        points: Sequence[Clicks],
        positions: Float[np.ndarray, "points 3"],
        constraints: Sequence[AbstractConstraint],
    ) -> list[tuple[int, str]]:
        """Return each click that, left out alone, makes the others agree, the likeliest first.

        Args:
            points: the clicks of all points of the constraints.
            positions: the points under the constraints, m.
            constraints: facts; one of them contradicts the clicks.

        Returns:
            The index of the point and the name of the view of each.
        """
        clicks = suspect_clicks(
            self._calibration,
            self.command,
            self._clicked_pixels(points),
            positions,
            constraints,
            **self._errors,
        )
        return [(click.point, self.names[click.view]) for click in clicks]

    def refined(
        self, points: Sequence[Clicks], constraints: Sequence[AbstractConstraint]
    ) -> tuple[list[PointEstimate], RefinedFeatures, tuple[ConstraintVerdict, ...]]:
        """Return the estimates of points under constraints, their refinement, and the verdicts.

        The constraints are judged by clicks that are as accurate as stated.
        """
        pixels, alone = self._clicked_pixels(points), self.estimates(points)
        widening = np.array([estimate.widening for estimate in alone])
        observations = ModelObservations(
            self._calibration, self.command, pixels, pixel_sigma=self.click_sigma
        )
        covariance = self._errors["covariance"]
        features = refine(None, observations, constraints, covariance=covariance)
        verdicts = features.verdicts
        if features.result.converged and (widening > 1.0).any():
            sigmas = np.broadcast_to(self.click_sigma * widening, pixels.shape[:2])
            widened = observations._replace(pixel_sigma=sigmas)
            attempt = refine(None, widened, constraints, covariance=covariance)
            features = attempt if attempt.result.converged else features
        wrong_clicks = [estimate.wrong_clicks for estimate in alone]
        return self._estimates_from(features, points, wrong_clicks, widening), features, verdicts

    def _clicked_pixels(self, points: Sequence[Clicks]) -> Float[np.ndarray, "views points 2"]:
        """Return the clicks of points as an array, NaN where a point was not clicked."""
        pixels = np.full((len(self.names), len(points), 2), np.nan)
        for k, clicks in enumerate(points):
            for name, pixel in clicks.items():
                pixels[self.names.index(name), k] = pixel
        return pixels

    def _estimates_from(
        self,
        solution: TriangulatedPoints | RefinedFeatures,
        points: Sequence[Clicks],
        wrong_clicks: Sequence[Mapping[str, DoubtedClick]],
        widening: Float[np.ndarray, "points"],
    ) -> list[PointEstimate]:
        """Return the estimates of points that were triangulated or refined."""
        # Points without a position are replaced by zeros; their predictions are not used.
        jacobians = pixel_jacobians(
            self._seen, np.where(solution.ok[:, None], solution.points, 0.0)
        )
        # For C = R R^T the part of the calibration is J C J^T = F F^T with F = J R.
        root = covariance_factor(solution.calibration_covariance)
        total, failures = solution.covariance(), solution.failures
        sizes = self._seen.image_sizes
        results = []
        for k, clicks in enumerate(points):
            J, pixels = jacobians.by_point[:, k], jacobians.pixels[:, k]
            # A point outside the picture is predicted, but not drawn.
            within = ((pixels > -0.5) & (pixels < sizes - 0.5)).all(axis=1)
            residuals = {
                name: tuple(solution.residuals[self.names.index(name), k].tolist())
                for name in clicks
            }
            results.append(
                PointEstimate(
                    solution.points[k],
                    solution.picture_covariance[k],
                    solution.calibration_jacobian[k] @ root,
                    pixels,
                    J @ total[k] @ J.swapaxes(1, 2),
                    jacobians.valid[:, k] & within & solution.ok[k],
                    residuals if solution.ok[k] else {},
                    wrong_clicks[k],
                    float(widening[k]),
                    failures.get(k, ""),
                )
            )
        return results

    def curves(self, view: str, pixel: tuple[float, float]) -> dict[str, EpipolarCurve]:
        """Return the epipolar curves of a pixel in all other views, by name."""
        index = self.names.index(view)
        others = [k for k in range(len(self.names)) if k != index]
        if not others:
            return {}
        curves = epipolar_curves(
            calibration_of_views(self._calibration, [index, *others]),
            command_at(self.command, index),
            np.array(pixel, dtype=float),
            command_at(self.command, others),
            self.depth_range[index],
        )
        return {self.names[k]: curve for k, curve in zip(others, curves, strict=True)}

    @property
    def common_depths(self) -> tuple[float, float]:
        """The nearest and the farthest depth of all views, m."""
        near, far = zip(*self.depth_range, strict=True)
        return min(near), max(far)

    def ray(
        self, view: str, pixel: tuple[float, float]
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Return the camera's centre and the unit direction of a pixel's ray in the world."""
        curves = self.curves(view, pixel)
        # All curves of a pixel have the same ray, and there are at least two views.
        curve = next(iter(curves.values()))
        return curve.origin, curve.direction

    def pixels_of(
        self, points: Float[np.ndarray, "points 3"]
    ) -> tuple[Float[np.ndarray, "views points 2"], Bool[np.ndarray, "views points"]]:
        """Return the pixels of world points in all views, and whether they are valid."""
        jacobians = pixel_jacobians(self._seen, points)
        return jacobians.pixels, jacobians.valid


def _depth_range(
    camera_from_world: Float[np.ndarray, "views 4 4"], centres: Float[np.ndarray, "views 3"]
) -> list[tuple[float, float]]:
    """Return the nearest and farthest depth of curves by view, around the common point."""
    axes = camera_from_world[:, 2, :3]
    # The point nearest to all optical axes: sum_v (I - a a^T) (x - c) = 0.
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    matrix, right = projectors.sum(axis=0), np.einsum("vij,vj->i", projectors, centres)
    spread = float(np.linalg.norm(np.ptp(centres, axis=0)))
    point = np.linalg.lstsq(matrix, right, rcond=1e-9)[0]
    distances = np.linalg.norm(point - centres, axis=1)
    in_front = np.einsum("vi,vi->v", point - centres, axes) > 0.0
    if spread == 0.0 or not in_front.all() or distances.max() > MAX_DEPTH_SCALE * spread:
        # Optical axes that are parallel or diverge: from one baseline to infinity.
        return [(max(spread, 1e-3), np.inf)] * len(centres)
    return [(DEPTH_RANGE[0] * d, DEPTH_RANGE[1] * d) for d in distances.tolist()]
