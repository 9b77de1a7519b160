"""Refine the poses of several accepted objects together.

Two things tie the objects of a scene to each other. Neighbours hide each other's edges, and have
edges beside each other: what was judged before its neighbours were known is measured anew, without
what they hide and explain. And the errors of the calibration are those of all objects: every object
tells of them by how its edges disagree between the views, which makes all poses more certain.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from ..geometry import host_exponentials
from ..modeling import CalibrationUncertainty
from .candidates import Prepared
from .distinct_poses import pose_distances
from .heavy_tails import NUMBERS
from .localization import Localization
from .pose_equations import (
    CommonErrors,
    PoseEquations,
    PoseStep,
    UndeterminedPoseError,
    solve_pose,
)
from .refinement import RefinedPose, refine_pose
from .scene import Claim, Scene


def refined_together(
    found: Sequence[Localization],
    scene: Scene,
    prepared: Sequence[Prepared],
    uncertainty: CalibrationUncertainty,
) -> list[Localization]:
    """Return what was found with the poses of all accepted objects refined together.

    Args:
        found: verdicts, which stay as they are, as does all that is not accepted.
        scene: pictures and views.
        prepared: the models.
        uncertainty: of the calibration in these views.
    """
    accepted = [one for one in found if one.accepted]
    if len(accepted) < 2:
        return list(found)
    claims = [
        scene.claim(one.refined.lines, prepared[one.model_index].coarse, one.world_from_object)
        for one in accepted
    ]
    refined = [
        _measured_anew(one, claims[:k] + claims[k + 1 :], scene, prepared, uncertainty)
        for k, one in enumerate(accepted)
    ]
    poses = _solved_together(refined, accepted, uncertainty)
    anew = iter(one._replace(refined=pose) for one, pose in zip(accepted, poses, strict=True))
    return [next(anew) if one.accepted else one for one in found]


def _measured_anew(
    one: Localization,
    others: Sequence[Claim],
    scene: Scene,
    prepared: Sequence[Prepared],
    uncertainty: CalibrationUncertainty,
) -> RefinedPose:
    """Return the refined pose of an object among known others; as it was where that is lost."""
    own = prepared[one.model_index]
    try:
        refined = refine_pose(
            one.world_from_object,
            own.model,
            own.fine,
            scene.views,
            scene.lookup_among(others),
            uncertainty,
        )
    # What the others leave may be too little; the pose is as certain as it was.
    except UndeterminedPoseError:
        return one.refined
    moved = pose_distances(own.model, one.world_from_object, refined.world_from_object[None])[0]
    return refined if moved < own.same else one.refined


def _solved_together(
    refined: Sequence[RefinedPose],
    objects: Sequence[Localization],
    uncertainty: CalibrationUncertainty,
) -> list[RefinedPose]:
    """Return poses with the errors in common that all objects tell of."""
    if not len(uncertainty.names) and all(one.model.is_exact for one in objects):
        # Nothing is common: each pose is what it is alone.
        return list(refined)
    # Of a model there may be several objects, whose vertices err alike.
    errors = {one.model_index: CommonErrors.of(uncertainty, one.model) for one in objects}
    equations = [pose.equations for pose in refined]
    by_vertices = [
        [
            own.by_vertices if one.model_index == k else np.zeros((len(own.block), len(e.vertices)))
            for k, e in errors.items()
        ]
        for own, one in zip(equations, objects, strict=True)
    ]
    all_equations = PoseEquations(
        np.concatenate([own.residuals for own in equations]),
        np.asarray(block_diag(*(own.by_pose for own in equations))),
        np.asarray(block_diag(*(own.noise for own in equations))),
        np.concatenate([own.by_calibration for own in equations]),
        np.block(by_vertices),
        # Two equations of each edge stay a block of their own.
        np.repeat(np.arange(sum(len(own.block) for own in equations) // NUMBERS), NUMBERS),
    )
    vertices = np.asarray(block_diag(*(own.vertices for own in errors.values())))
    step = solve_pose(all_equations, CommonErrors(uncertainty.covariance, vertices))
    return [_part(step, k, pose) for k, pose in enumerate(refined)]


def _part(step: PoseStep, k: int, before: RefinedPose) -> RefinedPose:
    """Return the pose of one object from the solution for all."""
    own = slice(6 * k, 6 * k + 6)
    tangent, equations = step.tangent[own], before.equations
    return before._replace(
        world_from_object=before.world_from_object @ host_exponentials(tangent),
        pictures=step.pictures[own, own],
        calibration=step.calibration[own, own],
        model=step.model[own, own],
        calibration_jacobian=step.calibration_jacobian[own],
        calibration_error=step.calibration_error,
        equations=equations._replace(residuals=equations.residuals - equations.by_pose @ tangent),
    )
