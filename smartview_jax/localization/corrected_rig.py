"""Check the camera poses on the objects that were found, and judge again with better ones.

A picture whose camera pose is wrong fits as well as any other, at another pose of the object. At
the pose that fits all views best its edges are found by halves or not at all, because they are
displaced by many pixels. Hence each view is searched about that pose as far as an edge may be off,
the pose at which most of the view's edges are found is refined by these alone, and judged as an
object in a single picture. Where the poses in the views differ by more than is stated
(`rig_noise`), the scene is judged again with the camera poses that its objects show.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from ..geometry import host_adjoints, host_transformed
from ..modeling import CalibrationUncertainty, SeenViews
from ..runtime.array_namespace import to_device
from .edges import EXPLAINED_DISTANCE, MAX_RADIUS, EdgeLookup
from .judging import Localization, Prepared, Query, Scene, evidence_of, judge, relative_std
from .refining import (
    NUMBERS,
    POSES_PER_BATCH,
    CommonErrors,
    RefinedPose,
    UndeterminedPoseError,
    line_equations,
    measured_lines,
    poses_on_edges,
    refine_pose,
)
from .rig_noise import PoseInView, RigNoise, ViewDisagreement, rig_noise
from .search import Hypothesis
from .search_rounds import SearchResult, hypotheses_of, judged_in_rounds


class JudgedScene(NamedTuple):
    """The verdicts on a scene, with the views and the uncertainty for which they hold.

    Attributes:
        result: verdicts, and where the search ended.
        scene: pictures, and views with the likeliest camera poses.
        query: with the uncertainty of these views.
    """

    result: SearchResult
    scene: Scene
    query: Query


def judged_with_rig(
    result: SearchResult,
    scene: Scene,
    query: Query,
    searched: Sequence[int],
) -> JudgedScene:
    """Return the verdicts on a scene, the camera poses having been checked on all its objects.

    Where the objects show that these are off beyond what is stated, the views are corrected by the
    likeliest errors, whose size widens the covariances of all poses. The poses that were found
    are judged again in the corrected views, and models without a pose are searched again.

    Args:
        result: verdicts with the views as given.
        scene: pictures and views as given.
        query: what is looked for, with the uncertainty of these views.
        searched: indices of the models that may be searched again.
    """
    noise = noise_of_rig(result.results, result.first, scene, query)
    disagreement = None if noise is None else noise.disagreement
    if noise is None or not noise.disagreement.is_likely:
        return JudgedScene(
            result._replace(results=_with_disagreement(result.results, disagreement)), scene, query
        )
    uncertainty = query.uncertainty.with_view_errors(noise.translation, noise.rotation)
    errors = np.concatenate([np.zeros(len(query.uncertainty.names)), noise.errors.ravel()])
    scene = scene.seen_by(uncertainty.corrected(scene.views, errors))
    query = query._replace(uncertainty=uncertainty, disagreement=disagreement)
    known = {obj.model_index for obj in result.results if obj.verdict.decision != "rejected"}

    again = judged_in_rounds(
        scene,
        query,
        [*hypotheses_of(result.results), *(h for h in result.first if h.model not in known)],
        [k for k in searched if k not in known],
    )
    again = again._replace(results=_with_disagreement(again.results, disagreement))
    return JudgedScene(again, scene, query)


def _with_disagreement(
    results: Sequence[Localization], disagreement: ViewDisagreement | None
) -> list[Localization]:
    """Return results whose evidence contains the disagreement of the views."""
    changed = []
    for obj in results:
        evidence = obj.verdict.evidence._replace(disagreement=disagreement)
        changed.append(obj._replace(verdict=obj.verdict._replace(evidence=evidence)))
    return changed


class Place(NamedTuple):
    """A pose at which an object of a model is or may be in all views.

    Attributes:
        model: index of the model.
        pose: world_from_object.
        explained_in_view: explained share of the visible edge length in each view; zero where the
            pose is not known to fit.
    """

    model: int
    pose: Float[np.ndarray, "4 4"]
    explained_in_view: Sequence[float]


def noise_of_rig(
    results: Sequence[Localization],
    hypotheses: Sequence[Hypothesis],
    scene: Scene,
    query: Query,
) -> RigNoise | None:
    """Return how far the camera poses are off, by all objects; None where they do not tell.

    If any objects are accepted, only these tell: a pose that is not may be wrong.

    Args:
        results: of the search in all views.
        hypotheses: poses from which they were found, the best first; a model that is nowhere in all
            views may be near one of them in a view alone.
        scene: pictures and views.
        query: what was looked for.
    """
    count = len(scene.views.camera_from_world)
    if count < 2:
        return None
    lookups = [_of_one_view(scene.lookup, view) for view in range(count)]
    places = [
        Place(obj.model_index, obj.world_from_object, obj.verdict.evidence.explained_in_view)
        for obj in results
        if obj.accepted
    ]
    if not places:
        known = [obj for obj in results if obj.verdict.decision == "open"]
        nowhere = [0.0] * count
        places = [Place(obj.model_index, obj.world_from_object, nowhere) for obj in known]
        starts = [(obj.model_index, obj.world_from_object) for obj in results]
        starts += [(each.model, each.world_from_object) for each in hypotheses]
        for model in {each[0] for each in starts} - {obj.model_index for obj in known}:
            poses = [pose for k, pose in starts if k == model][:POSES_PER_BATCH]
            best = _best_in_one_view(np.stack(poses), query.models[model], scene.views, lookups)
            places.append(Place(model, best, nowhere))
    objects = [_poses_in_views(place, scene.views, lookups, query) for place in places]
    return rig_noise(objects, scene.views, query.uncertainty)


def _best_in_one_view(
    starts: Float[np.ndarray, "starts 4 4"],
    entry: Prepared,
    views: SeenViews,
    lookups: Sequence[EdgeLookup],
) -> Float[np.ndarray, "4 4"]:
    """Return the pose near one of some poses at which a view alone shows most edges."""
    by_lookup = [poses_on_edges(entry.coarse, views, lookup, starts) for lookup in lookups]
    poses = np.concatenate([each for each, _ in by_lookup])
    explained = np.concatenate([lengths[:, 1] for _, lengths in by_lookup])
    return poses[int(explained.argmax())]


def _poses_in_views(
    place: Place, views: SeenViews, lookups: Sequence[EdgeLookup], query: Query
) -> list[PoseInView]:
    """Return the poses of an object in the views that show it well enough alone."""
    entry = query.models[place.model]
    seen = []
    for view, lookup in enumerate(lookups):
        start = place.pose
        # NaN, where too little of the object is visible, compares as False.
        if not place.explained_in_view[view] >= query.options.accepted_share:
            starts = _starts(start, entry, views, view)
            poses, lengths = poses_on_edges(entry.coarse, views, lookup, starts)
            start = poses[int(lengths[:, 1].argmax())]
        in_view = _pose_in_view(start, entry, views, view, lookup, query)
        if in_view is not None:
            seen.append(in_view)
    return seen


def _pose_in_view(
    start: Float[np.ndarray, "4 4"],
    entry: Prepared,
    views: SeenViews,
    view: int,
    lookup: EdgeLookup,
    query: Query,
) -> PoseInView | None:
    """Return the pose of an object in a view alone; None where that would not be accepted.

    Args:
        start: pose near it.
        entry: model of the object.
        views: cameras and poses.
        view: index of the view.
        lookup: edge points of this view alone.
        query: what was looked for.
    """
    try:
        refined = refine_pose(start, entry.model, entry.fine, views, lookup)
    except UndeterminedPoseError:
        return None
    pose = refined.world_from_object
    lines = measured_lines(entry.fine, views, lookup, pose, EXPLAINED_DISTANCE)
    in_view = jax.tree.map(lambda part: part[[view]], lines)
    evidence = evidence_of(in_view, entry.fine, is_alone=True, options=query.options)
    covariance = refined.pictures + refined.model
    uncertain = relative_std(entry.model, covariance)
    verdict = judge(evidence, POSES_PER_BATCH, np.inf, uncertainty=uncertain, options=query.options)
    if verdict.decision != "accepted":
        return None
    # With M = camera_from_object as the view shows it, and exp(d) camera_from_world the true pose
    # of the camera, the object is at
    #   camera_from_world^-1 exp(-d) M = camera_from_world^-1 M exp(-adjoint(M^-1) d).
    object_from_camera = np.linalg.inv(views.camera_from_world[view] @ pose)
    return PoseInView(
        view,
        pose,
        covariance,
        _by_calibration(refined, entry, views, query.uncertainty),
        -host_adjoints(object_from_camera),
        NUMBERS * int(refined.lines.measured[view].sum()) - 6,
    )


def _by_calibration(
    refined: RefinedPose, entry: Prepared, views: SeenViews, uncertainty: CalibrationUncertainty
) -> Float[np.ndarray, "6 numbers"]:
    """Return the derivatives of a pose's tangent by errors of the calibration.

    The pose was fitted as if there were none: with them, an error of the camera's pose would hide
    how exactly the picture shows the object.
    """
    if not uncertainty.names:
        return np.zeros((6, 0))
    pose, equations = refined.world_from_object, refined.equations
    with_errors = line_equations(refined.lines, entry.model, entry.fine, views, pose, uncertainty)
    # C J^T N^-1, where N contains the errors of the model.
    V = equations.by_vertices
    of_model = V @ CommonErrors.of(uncertainty, entry.model).vertices @ V.T
    weighted = np.linalg.solve(equations.noise + of_model, equations.by_pose)
    gain = refined.covariance @ weighted.T
    # A larger number raises the prediction, and so lowers the residuals.
    return -gain @ with_errors.by_calibration


def _of_one_view(lookup: EdgeLookup, view: int) -> EdgeLookup:
    """Return the edge points of a view alone, for the programs that are compiled for all views."""
    cells = np.asarray(lookup.cells)
    nothing = np.full_like(cells, lookup.pixels.shape[1] - 1)
    nothing[view] = cells[view]
    return eqx.tree_at(lambda each: each.cells, lookup, to_device(nothing))


def _starts(
    pose: Float[np.ndarray, "4 4"], entry: Prepared, views: SeenViews, view: int
) -> Float[np.ndarray, "starts 4 4"]:
    """Return a pose, and the poses at which its picture is displaced by `MAX_RADIUS` all around.

    From each of them edges are found within the same distance.
    """
    camera, camera_from_world = views.cameras[view], views.camera_from_world[view]
    depth = float(host_transformed(camera_from_world, entry.middle_at(pose))[2])
    angles = 2.0 * np.pi * np.arange(POSES_PER_BATCH - 1) / (POSES_PER_BATCH - 1)
    circle = np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles])
    poses = np.tile(pose, (POSES_PER_BATCH, 1, 1))
    # The axes of the camera, in the world.
    poses[1:, :3, 3] += MAX_RADIUS * depth / camera.alpha_u * circle @ camera_from_world[:3, :3]
    return poses
