"""Compare the pose of an object in each view alone with its pose in the other views.

A wrong mount, a wrong pair of cameras, or a robot that slipped moves whole pictures. The pose that
fits all of them best may still explain most edges, half a pixel off in each view, as if the edges
were inexact. But each picture alone fits far better than all of them together, at poses that differ
by more than their covariances allow.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool
from scipy.special import fdtrc

from ..modeling import CalibrationUncertainty, ObjectModel, SeenViews
from .heavy_tails import NUMBERS, HeavyTailedStep, solve_heavy_tailed
from .pose_equations import CommonErrors, PoseEquations, UndeterminedPoseError
from .refinement import RefinedPose, line_equations
from .wireframe import Wireframe


class ViewDisagreement(NamedTuple):
    """The difference between the poses in one view alone and in the other views.

    Attributes:
        view: index of the view.
        shift, turn: of the object's middle, m, and of the object, rad.
        relative: largest difference of a vertex, over the object's extent.
        probability: of so large a difference, if calibration and robot are as they are said to be.
        is_rig_uncertain: whether the difference may come from errors with a known covariance, so
            that its probability is known; otherwise calibration and robot are taken as exact.
    """

    view: int
    shift: float
    turn: float
    relative: float
    probability: float
    is_rig_uncertain: bool

    @property
    def message(self) -> str:
        """The difference in words."""
        return (
            f"view {self.view} alone puts it {1e3 * self.shift:.2g} mm and "
            f"{np.degrees(self.turn):.2g} degrees from where the other views do: a wrong "
            "calibration, or a robot that slipped?"
        )


def least_agreeing_view(
    refined: RefinedPose,
    model: ObjectModel,
    wireframe: Wireframe,
    views: SeenViews,
    uncertainty: CalibrationUncertainty,
) -> ViewDisagreement | None:
    """Return the view that agrees least with the others; None where too few edges tell.

    Args:
        refined: pose of the object in all views together.
        model: of the object.
        wireframe: of the model, with which the pose was refined.
        views: camera and poses.
        uncertainty: of the calibration in these views.
    """
    count = len(views.camera_from_world)
    if count < 2:
        return None
    errors = CommonErrors.of(uncertainty, model)
    pose = refined.world_from_object
    equations = line_equations(refined.lines, model, wireframe, views, pose, uncertainty)
    view_of = np.repeat(np.nonzero(refined.lines.measured)[0], NUMBERS)
    # Two views differ from each other by the same, whichever is taken.
    tested = [count - 1] if count == 2 else range(count)
    compared = [_disagreement(equations, errors, view_of == view, view, model) for view in tested]
    disagreements = [each for each in compared if each is not None]
    if not disagreements:
        return None
    largest = min(disagreements, key=lambda each: each.probability)
    # Each of these views might have been the one that differs most.
    return largest._replace(probability=min(1.0, len(disagreements) * largest.probability))


def _disagreement(
    equations: PoseEquations,
    errors: CommonErrors,
    of_view: Bool[np.ndarray, "n"],
    view: int,
    model: ObjectModel,
) -> ViewDisagreement | None:
    """Return the difference between the equations of a view and the others; None for too few."""
    parts = [_solved(equations.of(rows), errors) for rows in (of_view, ~of_view)]
    first, second = parts
    if first is None or second is None:
        return None
    a, b = first.step, second.step
    difference = a.tangent - b.tangent
    # Errors of the calibration that both share cancel.
    jacobian = a.calibration_jacobian - b.calibration_jacobian
    covariance = a.pictures + b.pictures + a.model + b.model
    covariance = covariance + jacobian @ errors.calibration @ jacobian.T
    square = float(difference @ np.linalg.solve(covariance, difference))
    # The size of the errors is estimated from as many numbers as the pose leaves over.
    freedom = min(int(rows.sum()) for rows in (of_view, ~of_view)) - 6
    probability = float(fdtrc(6, freedom, square / 6.0))
    moves = difference[:3] + np.cross(difference[3:], model.vertices)
    return ViewDisagreement(
        view,
        float(np.linalg.norm(moves.mean(axis=0))),
        float(np.linalg.norm(difference[3:])),
        float(np.linalg.norm(moves, axis=1).max()) / model.extent,
        probability,
        bool(errors.calibration.size),
    )


def _solved(equations: PoseEquations, errors: CommonErrors) -> HeavyTailedStep | None:
    """Return the solution of some equations; None where they leave nothing over or undetermined."""
    if len(equations.residuals) <= 6:
        return None
    try:
        return solve_heavy_tailed(equations, errors)
    except UndeterminedPoseError:
        return None
