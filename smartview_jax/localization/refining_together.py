"""Refine the poses of several accepted objects together.

Two things tie the objects of a scene to each other. Neighbours hide each other's edges, and have
edges beside each other: what was judged before its neighbours were known is measured anew, without
what they hide and explain. And the errors of the calibration are those of all objects: every object
tells of them by how its edges disagree between the views, which makes all poses more certain.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import block_diag

from ..features import EdgePoints
from ..geometry import host_exponentials
from ..modeling import CalibrationUncertainty
from .candidates import Prepared, Scene
from .distinct_poses import pose_distances
from .edge_lookup import EdgeLookup
from .known_surfaces import KnownSurfaces
from .localization import Localization
from .pose_equations import CommonErrors, PoseEquations, PoseStep, solve_pose
from .refinement import RefinedPose, explained_edge_points, refine_pose


class _Claim(NamedTuple):
    """The parts of the pictures that an object takes from the others.

    Attributes:
        free: which edge points of each view it does not explain.
        inverse_depth: of its surface in each view, 1/m; zero where it is not.
    """

    free: list[Bool[np.ndarray, "_"]]
    inverse_depth: Float[np.ndarray, "views rows columns"]


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
    points = [one.edge_points for one in scene.pictures]
    claims = [_claim(one, prepared[one.model_index], scene, points) for one in accepted]
    refined = []
    for k, one in enumerate(accepted):
        others = [other for j, other in enumerate(claims) if j != k]
        refined.append(_measured_anew(one, others, scene, prepared, points, uncertainty))
    poses = _solved_together(refined, accepted, uncertainty)
    anew = iter(one._replace(refined=pose) for one, pose in zip(accepted, poses, strict=True))
    return [next(anew) if one.accepted else one for one in found]


def _claim(
    one: Localization, prepared: Prepared, scene: Scene, points: Sequence[EdgePoints]
) -> _Claim:
    """Return the parts of the pictures that an object takes from the others."""
    surface = KnownSurfaces(scene.views)
    surface.add(prepared.coarse, one.world_from_object)
    free = []
    for view, own in enumerate(points):
        is_free = np.ones(len(own.pixels), dtype=bool)
        is_free[explained_edge_points(one.refined.lines, view, own)] = False
        free.append(is_free)
    return _Claim(free, surface.inverse_depth)


def _measured_anew(
    one: Localization,
    others: Sequence[_Claim],
    scene: Scene,
    prepared: Sequence[Prepared],
    points: Sequence[EdgePoints],
    uncertainty: CalibrationUncertainty,
) -> RefinedPose:
    """Return the refined pose of an object among known others; as it was where that is lost."""
    known = KnownSurfaces(scene.views)
    known.add_triangles(scene.known)
    depth = np.maximum.reduce([known.inverse_depth, *(other.inverse_depth for other in others)])
    free = [np.logical_and.reduce(own) for own in zip(*(o.free for o in others), strict=True)]
    lookup = EdgeLookup.of(points, scene.views.camera.image_size, free, depth)
    own = prepared[one.model_index]
    try:
        refined = refine_pose(
            one.world_from_object, own.model, own.fine, scene.views, lookup, uncertainty
        )
    except ValueError:
        return one.refined
    moved = pose_distances(own.model, one.world_from_object, refined.world_from_object[None])[0]
    return refined if moved < own.same else one.refined


def _solved_together(
    refined: Sequence[RefinedPose],
    objects: Sequence[Localization],
    uncertainty: CalibrationUncertainty,
) -> list[RefinedPose]:
    """Return poses with the errors in common that all objects tell of."""
    # Of a model there may be several objects, whose vertices err alike.
    models = {one.model_index: one.model for one in objects}
    errors = {k: CommonErrors.of(uncertainty, model) for k, model in models.items()}
    vertices = [len(own.vertices) for own in errors.values()]
    if not len(uncertainty.names) and not sum(vertices):
        # Nothing is common: each pose is what it is alone.
        return list(refined)
    starts = dict(zip(models, np.cumsum([0, *vertices]), strict=False))
    by_vertices = []
    for pose, one in zip(refined, objects, strict=True):
        own = pose.equations.by_vertices
        placed = np.zeros((len(own), sum(vertices)))
        start = starts[one.model_index]
        placed[:, start : start + own.shape[1]] = own
        by_vertices.append(placed)
    all_equations = [pose.equations for pose in refined]
    blocks = np.cumsum([0, *(one.block.max() + 1 for one in all_equations)])
    step = solve_pose(
        PoseEquations(
            np.concatenate([one.residuals for one in all_equations]),
            np.asarray(block_diag(*(one.by_pose for one in all_equations))),
            np.asarray(block_diag(*(one.noise for one in all_equations))),
            np.concatenate([one.by_calibration for one in all_equations]),
            np.concatenate(by_vertices),
            np.concatenate(
                [one.block + k for one, k in zip(all_equations, blocks[:-1], strict=True)]
            ),
        ),
        CommonErrors(
            uncertainty.covariance, np.asarray(block_diag(*(e.vertices for e in errors.values())))
        ),
    )
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
