"""Plan the next views of a calibration, or the first views of a rough one, with their benefit."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from ..calibration import Calibration
from ..dataset import DepthNoise
from ..engine import Noise, inverse_of_covariance, parameter_names
from ..geometry import ViewedRegion, host_matrices
from ..joint import SavedEstimate
from ..robots import JointsLike, SerialArm
from ..runtime.array_namespace import to_device
from .candidate_selection import StopRule, ViewRequirements, worth_of_views
from .checks import Limits
from .commands import viewpoint_commands
from .information_model import InformationModel
from .optimality_criteria import OptimalityCriterion, a_optimal, i_optimal
from .view_planning import choose_views
from .view_range import ViewRange

TYPICAL_NOISE = Noise(0.3, 1e-4, float(np.deg2rad(0.02)))
"""Errors of pixels and of an industrial arm that are assumed before any picture is taken."""

PICTURE_PARTS = (0.35, 0.6)
"""Smallest and largest share of the picture's shorter side that the target fills in first views."""


class ViewPlan(NamedTuple):
    """The views to take next, best first, and the benefit of each.

    Attributes:
        camera_from_world: camera poses of the views as matrices, `(count, 4, 4)`; of a rig, of the
            camera that each is a view of.
        before: value of the criterion without them; infinite where something is undetermined.
        values: its value after the first of all considered views, after two, and so on.
        unit: unit of the criterion: m, or px if the hand-eye transform is fixed.
        distance: distance from the camera of the point whose displacement is minimised, m.
        cameras: names of a rig's cameras; empty for one camera.
    """

    camera_from_world: Float[np.ndarray, "count 4 4"]
    before: float
    values: tuple[float, ...]
    unit: str
    distance: float
    cameras: tuple[str, ...] = ()

    @property
    def after(self) -> float:
        """The value of the criterion after the views of the plan."""
        count = len(self.camera_from_world)
        return self.values[count - 1] if count else self.before


def model_from_estimate(
    estimate: SavedEstimate,
    points: Float[np.ndarray, "points 3"],
    near: JointsLike | None = None,
    depth_noise: DepthNoise | None = None,
) -> InformationModel:
    """Return the information model whose prior is the covariance of an estimate.

    Args:
        estimate: a calibration with its covariance and noise.
        points: target points, m.
        near: joint readings, if the estimate contains an arm's joints.
        depth_noise: noise of the depths that every view has; None without a depth sensor.

    Raises:
        ValueError: the estimate has parameters that its calibration lacks.
    """
    calibration, noise = estimate.calibration, estimate.noise
    field = calibration.field
    if noise is not None:
        # All knowledge of the robot's smooth error is in the covariance; no other prior applies.
        noise = noise.with_unit_groups(field)
    estimated = set(estimate.parameter_names)
    model = InformationModel.from_calibration(
        calibration,
        points,
        estimate.pixel_sigma if noise is None else noise,
        field=field,
        fixed=tuple(name for name in parameter_names(calibration) if name not in estimated),
        free=tuple(name for name in ("target_scale",) if name in estimated),
        near=near,
        depth_noise=depth_noise,
    )
    # The order in the file need not be the model's.
    order = [estimate.parameter_names.index(name) for name in model.parameter_names]
    information = inverse_of_covariance(estimate.covariance[np.ix_(order, order)])
    return eqx.tree_at(lambda m: m.prior_information, model, to_device(information))


def first_view_distances(
    calibration: Calibration, points: Float[np.ndarray, "points 3"]
) -> tuple[float, float]:
    """Return the distances, m, from which the target fills `PICTURE_PARTS` of the picture."""
    # By the diagonal, so that the target fits the picture at any rotation.
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    focal = min(float(calibration.camera.alpha_u), float(calibration.camera.alpha_v))
    shorter_side = min(calibration.camera.image_size)
    # Size in the picture = focal * extent / distance.
    far, near = (focal * extent / (part * shorter_side) for part in PICTURE_PARTS)
    return near, far


def with_assumed_region(
    calibration: Calibration,
    points: Float[np.ndarray, "points 3"],
    distances: tuple[float, float],
    above: bool,
) -> Calibration:
    """Return a rough calibration with the side from which its first views see the target.

    Views and tool are then checked to stay on that side, as with a fitted calibration.
    """
    side = 1.0 if above else -1.0
    # The plane contains the points that are farthest from the cameras.
    height = points[:, 2]
    plane_z = height.min() if above else height.max()
    centroid = points.mean(axis=0) + np.array([0.0, 0.0, side * float(np.mean(distances))])
    region = ViewedRegion(side, plane_z, centroid, distances[1], distances, 0.0)
    return dataclasses.replace(calibration, region=region)


def plan_views(
    model: InformationModel,
    views: ViewRange,
    stop: StopRule,
    *,
    needs: ViewRequirements | None = None,
    arm: SerialArm | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> ViewPlan:
    """Choose views that the robot may take, up to where another one is no longer worth its time.

    Args:
        model: the current information, and the information of views.
        stop: when the plan ends; its goal is in m or px.
        needs: what a view has to show; its `allowed` is called with the commands `base_from_tool`
            `(views)`, such as for those in a box.
        arm: the arm, if its joints are known; it is solved near the model's readings.
        seed: seed of the random candidates.
        progress: called with a text for each stage.

    Raises:
        ValueError: fewer than `stop.count` candidates may be taken.
    """
    needs = needs or ViewRequirements()
    limits = Limits(
        border_margin=needs.border_margin, min_visible_fraction=needs.min_visible_fraction
    )

    # Candidates have to pass the checks that would later refuse their commands.
    def is_safe(poses) -> Bool[Array, "views"]:
        near = model.near if arm is not None else None
        commands = viewpoint_commands(model.calibration, poses, None, arm, near, limits)
        safe = np.asarray(commands.checks.safe)
        if needs.allowed is not None:
            safe = safe & np.asarray(needs.allowed(commands.base_from_tool))
        return to_device(safe)

    distance = 0.5 * sum(views.distance)
    criterion = _criterion(model, views, distance, seed)
    # Sorted best first, so that the first few of them are a good choice too.
    chosen = choose_views(
        model,
        criterion,
        stop.count,
        views,
        seed=seed,
        # Candidates are checked one by one; views moved by the gradient might fail the checks.
        refine=False,
        progress=progress,
        border_margin=needs.border_margin,
        min_visible_fraction=needs.min_visible_fraction,
        allowed=is_safe,
    )
    worth = worth_of_views(criterion, model.prior_information, chosen.cumulative_criterion, stop)
    matrices = host_matrices(chosen.camera_from_world)[: worth.needed]
    return ViewPlan(matrices, worth.before, worth.values, criterion.unit, distance)


def _criterion(
    model: InformationModel, views: ViewRange, distance: float, seed: int
) -> OptimalityCriterion:
    """Return the criterion to minimise: the error of a point before the camera, m, or of pixels."""
    mount = model.calibration.transform_names[0]
    if any(name.startswith(f"{mount}.") for name in model.parameter_names):
        return a_optimal(model, distance)
    # With a fixed hand-eye transform only the prediction of pixels can be improved.
    coordinates = views.sample(np.random.default_rng(seed), 50)
    return i_optimal(model, views.poses(coordinates))
