"""Refine the poses of several accepted objects together.

Two things couple the objects of a scene. Neighbours occlude each other, and have edges next to each
other's: objects that were judged before their neighbours were known are measured again, without the
edge points that these explain or hide. And all objects share the errors of the calibration: every
object determines them by how its edges disagree between the views, which makes all poses more
accurate.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from ..geometry import host_exponentials
from ..modeling import CalibrationUncertainty
from .distinct_poses import pose_distances
from .judging import Claim, Localization, Prepared, Scene
from .refining import (
    CommonErrors,
    PoseEquations,
    PoseStep,
    RefinedPose,
    UndeterminedPoseError,
    refine_pose,
    solve_pose,
)


def refined_together(
    localizations: Sequence[Localization],
    scene: Scene,
    prepared: Sequence[Prepared],
    uncertainty: CalibrationUncertainty,
) -> list[Localization]:
    """Return the results with the poses of all accepted objects refined together.

    Args:
        localizations: all results; verdicts, and poses that are not accepted, stay unchanged.
        scene: pictures and views.
        prepared: the models.
        uncertainty: of the calibration in these views.
    """
    accepted = [obj for obj in localizations if obj.accepted]
    if len(accepted) < 2:
        return list(localizations)
    claims = [
        scene.claim(obj.refined.lines, prepared[obj.model_index].coarse, obj.world_from_object)
        for obj in accepted
    ]
    refined = [
        _remeasured(obj, claims[:k] + claims[k + 1 :], scene, prepared, uncertainty)
        for k, obj in enumerate(accepted)
    ]
    poses = _solved_together(refined, accepted, uncertainty)
    updated = iter(obj._replace(refined=pose) for obj, pose in zip(accepted, poses, strict=True))
    return [next(updated) if obj.accepted else obj for obj in localizations]


def _remeasured(
    obj: Localization,
    others: Sequence[Claim],
    scene: Scene,
    prepared: Sequence[Prepared],
    uncertainty: CalibrationUncertainty,
) -> RefinedPose:
    """Return the refined pose of an object among known others; unchanged where that fails."""
    entry = prepared[obj.model_index]
    try:
        refined = refine_pose(
            obj.world_from_object,
            entry.model,
            entry.fine,
            scene.views,
            scene.lookup_among(others),
            uncertainty,
        )
    # Too few edge points may be left; the pose then stays as it was.
    except UndeterminedPoseError:
        return obj.refined
    moved = pose_distances(entry.model, obj.world_from_object, refined.world_from_object[None])[0]
    return refined if moved < entry.same else obj.refined


def _solved_together(
    refined: Sequence[RefinedPose],
    objects: Sequence[Localization],
    uncertainty: CalibrationUncertainty,
) -> list[RefinedPose]:
    """Return the poses, with the common errors estimated from all objects."""
    if not len(uncertainty.names) and all(obj.model.is_exact for obj in objects):
        # No common errors: each pose is independent of the others.
        return list(refined)
    # Several objects may be of one model; they share the errors of its vertices.
    errors = {obj.model_index: CommonErrors.of(uncertainty, obj.model) for obj in objects}
    equations = [pose.equations for pose in refined]
    by_vertices = [
        [
            part.by_vertices
            if obj.model_index == k
            else np.zeros((len(part.residuals), len(e.vertices)))
            for k, e in errors.items()
        ]
        for part, obj in zip(equations, objects, strict=True)
    ]
    all_equations = PoseEquations(
        np.concatenate([part.residuals for part in equations]),
        np.asarray(block_diag(*(part.by_pose for part in equations))),
        np.asarray(block_diag(*(part.noise for part in equations))),
        np.concatenate([part.by_calibration for part in equations]),
        np.block(by_vertices),
    )
    vertices = np.asarray(block_diag(*(part.vertices for part in errors.values())))
    turns = np.asarray(block_diag(*(errors[obj.model_index].turns for obj in objects)))
    step = solve_pose(all_equations, CommonErrors(uncertainty.covariance, vertices, turns))
    return [_part(step, k, pose) for k, pose in enumerate(refined)]


def _part(step: PoseStep, k: int, before: RefinedPose) -> RefinedPose:
    """Return the refined pose of one object, from the solution for all."""
    rows = slice(6 * k, 6 * k + 6)
    tangent, equations = step.tangent[rows], before.equations
    return before._replace(
        world_from_object=before.world_from_object @ host_exponentials(tangent),
        pictures=step.pictures[rows, rows],
        calibration=step.calibration[rows, rows],
        model=step.model[rows, rows],
        calibration_jacobian=step.calibration_jacobian[rows],
        calibration_error=step.calibration_error,
        equations=equations._replace(residuals=equations.residuals - equations.by_pose @ tangent),
    )
