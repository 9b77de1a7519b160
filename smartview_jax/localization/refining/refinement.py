"""Estimate the pose of an object from all its features in the pictures, with its covariance.

The edge points along the visible wireframe are matched again in every step, and written as linear
equations (`pose_equations`) that combine the pictures' noise with the errors of the calibration and
the model, so that an inaccurate robot does not make one view contradict another.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from scipy.special import chdtri

from ...features import EdgePoints
from ...geometry import host_exponentials, host_logarithms
from ...modeling import CalibrationUncertainty, ObjectModel, SeenViews
from ...runtime.array_namespace import to_device
from ..edges import MIN_ALIGNMENT, EdgeLines, EdgeLookup, Wireframe, lines_in_views, padded_poses
from .heavy_tails import solve_heavy_tailed
from .pose_equations import CommonErrors, PoseEquations, line_equations

MAX_STEPS = 20
"""Largest number of Gauss-Newton steps."""

CONVERGED = 0.02
"""Length of a step, in standard deviations of the pose, at which the fit has converged."""

FINAL_RADIUS = 4.0
"""Search radius of edge points in the final fit, px: calibration errors shift edges by some px."""

CONSISTENT_SQUARE = float(chdtri(2, 0.001))
"""Largest squared error of a consistent edge (two numbers), relative to its scale."""

EXPLAINED_REACH = 3.0
"""Distance from a measured edge point within which others belong to the same edge, px."""

FIT_SAMPLES = 1024
"""Number of samples along all edges in the final fit: enough to reach almost every edge point."""


class RefinedPose(NamedTuple):
    """The pose of an object with its covariance, and the edges from which it was estimated.

    Attributes:
        world_from_object: pose.
        pictures, calibration, model: parts of the covariance of the pose's tangent, translation
            first: `world_from_object @ SE3.exp(tangent)`; m and rad.
        calibration_jacobian: derivatives of that tangent by the numbers of the views'
            `CalibrationUncertainty`; everything else that depends on these numbers errs together
            with it.
        shared_names: names of the first of these numbers, which belong to the calibration and are
            common to all views; the others are the robot's noise in these views.
        calibration_error: likeliest errors of these numbers, estimated from the object's edges.
        absorbed: number of edge measurements that these errors explain.
        edge_sigma: estimated standard deviation of whole edges from the model beyond their points'
            noise, px.
        lines: edges as measured at the pose, in all views.
        consistent: which of them agree with their noise; the others have little weight.
        equations: equations about the tangent at the pose, solved by zero.
    """

    world_from_object: Float[np.ndarray, "4 4"]
    pictures: Float[np.ndarray, "6 6"]
    calibration: Float[np.ndarray, "6 6"]
    model: Float[np.ndarray, "6 6"]
    calibration_jacobian: Float[np.ndarray, "6 numbers"]
    shared_names: tuple[str, ...]
    calibration_error: Float[np.ndarray, "numbers"]
    absorbed: float
    edge_sigma: float
    lines: EdgeLines
    consistent: Bool[np.ndarray, "views E"]
    equations: PoseEquations

    @property
    def covariance(self) -> Float[np.ndarray, "6 6"]:
        """The covariance of the pose: pictures, calibration and model together."""
        return self.pictures + self.calibration + self.model


def _is_at_one_of(
    earlier: Sequence[Float[np.ndarray, "4 4"]],
    pose: Float[np.ndarray, "4 4"],
    covariance: Float[np.ndarray, "6 6"],
) -> bool:
    """Return whether a step returned to an earlier pose, measured by the pose's covariance."""
    tangents = host_logarithms(np.linalg.inv(np.stack(earlier)) @ pose)
    squared = (tangents * np.linalg.solve(covariance, tangents.T).T).sum(axis=1)
    return bool(squared.min() < CONVERGED**2)


def refine_pose(
    start: Float[np.ndarray, "4 4"],
    model: ObjectModel,
    wireframe: Wireframe,
    views: SeenViews,
    lookup: EdgeLookup,
    uncertainty: CalibrationUncertainty | None = None,
    radius: float = FINAL_RADIUS,
) -> RefinedPose:
    """Return the pose that fits the edge points of all views best.

    The errors of edges have heavy tails (`heavy_tails`): shadows and rounded corners displace whole
    edges, which count the less, the farther they are off.

    Args:
        start: pose within some pixels of the solution, as `converged_poses` returns.
        model: of the object.
        wireframe: of the model, with `FIT_SAMPLES` points.
        views: camera and poses.
        lookup: edge points of the views.
        uncertainty: of the calibration in these views; None for an exact one.
        radius: largest distance of an edge point from its predicted edge, px.

    Raises:
        UndeterminedPoseError: too few edges are found to determine a pose.
    """
    uncertainty = CalibrationUncertainty.none(views) if uncertainty is None else uncertainty
    errors, pose = CommonErrors.of(uncertainty, model), start
    earlier = list[Float[np.ndarray, "4 4"]]()
    # The edges are measured again in each step, because the matched edge points depend on the pose.
    for remaining in range(MAX_STEPS)[::-1]:
        lines = measured_lines(wireframe, views, lookup, pose, radius)
        equations = line_equations(lines, model, wireframe, views, pose, uncertainty)
        step, solved, squared, edge_sigma = solve_heavy_tailed(equations, errors)
        earlier.append(pose)
        pose = pose @ host_exponentials(step.tangent)
        # Where edges come and go from pose to pose, the steps may cycle.
        if _is_at_one_of(earlier, pose, step.covariance) or not remaining:
            consistent = np.zeros(lines.measured.shape, dtype=bool)
            consistent[lines.measured] = squared <= CONSISTENT_SQUARE
            at_pose = solved._replace(residuals=solved.residuals - solved.by_pose @ step.tangent)
            parts = step.pictures, step.calibration, step.model, step.calibration_jacobian
            parts = *parts, uncertainty.shared_names, step.calibration_error, step.absorbed
            return RefinedPose(pose, *parts, edge_sigma, lines, consistent, at_pose)
    raise AssertionError("the last step returns")


def measured_lines(
    wireframe: Wireframe,
    views: SeenViews,
    lookup: EdgeLookup,
    world_from_object: Float[np.ndarray, "4 4"],
    radius: float,
) -> EdgeLines:
    """Return the lines fitted to edge points along an object's visible edges, on the host.

    Args:
        wireframe: of the model.
        views: camera and poses.
        lookup: edge points of the views.
        world_from_object: pose.
        radius: largest distance of an edge point from its predicted edge, px.
    """
    poses = padded_poses(views.camera_from_world)
    lines = lines_in_views(
        wireframe,
        views.camera_for(len(poses)),
        lookup,
        to_device(poses),
        to_device(world_from_object),
        to_device(float(radius)),
    )
    count = len(views.camera_from_world)
    return jax.tree.map(lambda part: np.asarray(part)[:count], lines)


def explained_edge_points(
    lines: EdgeLines, view: int, points: EdgePoints
) -> Int[np.ndarray, "explained"]:
    """Return the indices of the edge points of a view that an object's edges explain.

    They lie within `EXPLAINED_REACH` of the edge through a measured point, as far along it as the
    point's sample reaches, and have the same direction.
    """
    with_edge = np.flatnonzero(np.isfinite(lines.distances[view]))
    if not len(with_edge):
        return np.zeros(0, dtype=int)
    # Points between two samples of an edge were not measured, but are explained too: each sample
    # stands for a part of its edge, along which further places are `EXPLAINED_REACH` apart.
    half_px = 0.5 * lines.sample_px[view][with_edge]
    most = int(np.ceil(half_px.max() / EXPLAINED_REACH))
    offsets = EXPLAINED_REACH * np.arange(-most, most + 1)
    sample, k = np.nonzero(np.abs(offsets) <= half_px[:, None])
    measured = lines.points[view][with_edge][sample]
    n = lines.normals[view][with_edge][sample]
    along = np.column_stack([n[:, 1], -n[:, 0]])
    places = points.pixels[measured] + offsets[k, None] * along
    low, high = places.min(axis=0) - EXPLAINED_REACH, places.max(axis=0) + EXPLAINED_REACH
    around = np.flatnonzero(((points.pixels >= low) & (points.pixels <= high)).all(axis=1))
    pixels = points.pixels[around]
    gap, nearest = KDTree(places).query(pixels, distance_upper_bound=EXPLAINED_REACH)
    is_near = np.isfinite(gap)
    near, normals = around[is_near], points.normals[measured[np.asarray(nearest)[is_near]]]
    aligned = np.abs((points.normals[near] * normals).sum(axis=1)) >= MIN_ALIGNMENT
    return near[aligned]
