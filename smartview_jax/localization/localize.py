"""Find known objects in calibrated pictures, with a verdict and a covariance for each.

Hypotheses are refined on the pictures' edges, ranked by the visible edge length that they explain,
and judged one after the other: edge points that one object explains are no evidence for the next.
The poses of accepted objects are refined together at the end.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
from jaxtyping import Float

from ..calibration import Calibration
from ..engine import Noise
from ..evaluation import CalibrationEstimate
from ..features import PictureEvidence, picture_evidence
from ..modeling import CalibrationUncertainty, ObjectModel, SeenViews
from ..robots import Command, CommandLike
from .candidates import Prepared, converged_candidates
from .depth_buffers import checked_triangles
from .hypotheses import Hypothesis, checked_box, find_hypotheses
from .judging import judged
from .localization import Localization, Localizations, model_name
from .pose_convergence import THREADS
from .refining_together import refined_together
from .scene import Scene


def localize(
    pictures_or_features: Sequence[np.ndarray | PictureEvidence],
    poses: CommandLike,
    calibration: Calibration,
    models: ObjectModel | Sequence[ObjectModel],
    *,
    covariance: CalibrationEstimate | None = None,
    noise: Noise | None = None,
    previous: Localizations | None = None,
    hypotheses: Sequence[Hypothesis] | None = None,
    workspace: Float[np.ndarray, "2 3"] | None = None,
    occluders: Float[np.ndarray, "triangles 3 3"] | None = None,
) -> Localizations:
    """Find objects of known models in one, two or more calibrated pictures.

    Args:
        pictures_or_features: uint8 pictures, or the result of `picture_evidence` for each; one a
            view.
        poses: poses that the robot reported in each view, `base_from_tool`.
        calibration: the calibrated camera; poses of objects are in its world frame.
        models: models of the objects that may be there, any number of each.
        covariance: a joint fit, or a bound, with the uncertainty of the calibration; None takes the
            calibration as exact.
        noise: sizes of the robot's noise in these views; by default the noise of the fit.
        previous: result for earlier views of the same scene. Their pictures are used together with
            the new ones, and every pose that is accepted, open or a rival is judged again. Models
            without such a pose are searched again in all pictures.
        hypotheses: initial poses; by default they are searched in the pictures.
        workspace: two opposite corners of a box in the world, m, that contains the objects, such as
            a bin; nothing outside is found. None for anywhere.
        occluders: triangles in the world, m, of known obstacles such as the walls of a bin; edges
            that they occlude do not count as missing.

    Returns:
        The objects found, accepted ones first; `messages` says why others were not accepted.

    Raises:
        ValueError: no views, numbers of poses and pictures that differ, a model without edges, a
            picture without usable edges or given twice, a workspace that is not a box, occluders
            that are not triangles, or a hypothesis of an unknown model; the message names the view,
            model or argument.
    """
    prepared, triangles = _prepared(models), checked_triangles(occluders)
    box = None if workspace is None else checked_box(workspace)
    _check_models(hypotheses, previous, len(prepared))
    views = _checked_views(pictures_or_features, poses, calibration)
    # OpenCV and NumPy release the interpreter lock, so that pictures are searched in parallel.
    with ThreadPoolExecutor(THREADS) as pool:
        count = len(pictures_or_features)
        found_in = pool.map(_evidence, range(count), pictures_or_features, [calibration] * count)
        pictures = tuple(found_in)
    if previous is not None:
        command = _joined_commands(previous.command, _own_command(views))
        pictures = (*previous.pictures, *pictures)
        views = SeenViews.of(calibration, command)
    _check_distinct(pictures)
    uncertainty = CalibrationUncertainty.of(views, calibration, covariance, noise)
    # With earlier results only their remaining poses are judged in the new views, without a
    # search.
    starts = _hypotheses_of(previous) if hypotheses is None else list(hypotheses)
    if hypotheses is None:
        starts += _searched(pictures, views, prepared, {h.model for h in starts}, box)
    scene = Scene(views, pictures, triangles)
    candidates = converged_candidates(scene, prepared, starts)
    # Checked again after the fit, which may have moved a pose out of the box. Only the middle is
    # checked: the vertices were when the pose was proposed, and the walls are not exact.
    if box is not None:
        middles = [prepared[c.model].middle_at(c.pose) for c in candidates]
        inside = [bool(((box[0] <= m) & (m <= box[1])).all()) for m in middles]
        candidates = [c for c, is_in in zip(candidates, inside, strict=True) if is_in]
    results = judged(scene, prepared, candidates, uncertainty, len(starts))
    results = refined_together(results, scene, prepared, uncertainty)
    return Localizations(
        _reported(results), _messages(prepared, results, starts), pictures, _own_command(views)
    )


def _prepared(models: ObjectModel | Sequence[ObjectModel]) -> list[Prepared]:
    """Return models with their wireframes."""
    given = [models] if isinstance(models, ObjectModel) else list(models)
    if not given:
        raise ValueError("models: expected at least one, found none")
    for k, model in enumerate(given):
        if not len(model.edges):
            raise ValueError(f"models: model {k} {model.name!r} has no edges, nothing to look for")
    return [Prepared.of(model) for model in given]


def _checked_views(
    pictures: Sequence[np.ndarray | PictureEvidence], poses: CommandLike, calibration: Calibration
) -> SeenViews:
    """Return the views, after checking that each picture has a pose."""
    if isinstance(pictures, np.ndarray | PictureEvidence) or not len(pictures):
        raise ValueError("pictures: expected a list of pictures, one for each view")
    if not isinstance(calibration, Calibration):
        kind = type(calibration).__name__
        raise ValueError(
            f"calibration: expected a Calibration, such as fit.calibration; found {kind}"
        )
    views = SeenViews.of(calibration, poses)
    count = len(views.camera_from_world)
    if count != len(pictures):
        raise ValueError(
            f"poses: {len(pictures)} pictures and {count} poses; view {min(count, len(pictures))} "
            "has only one of them, so it is not calibrated"
        )
    return views


def _evidence(
    view: int, picture: np.ndarray | PictureEvidence, calibration: Calibration
) -> PictureEvidence:
    """Return the edges, corners and segments of a view's picture."""
    if isinstance(picture, PictureEvidence):
        return picture
    if not isinstance(picture, np.ndarray):
        raise ValueError(
            f"view {view}: expected a picture, or what picture_evidence found in it; found "
            f"{type(picture).__name__}"
        )
    try:
        return picture_evidence(picture, calibration.camera)
    except ValueError as error:
        raise ValueError(f"view {view}: {error}") from None


def _check_distinct(pictures: Sequence[PictureEvidence]) -> None:
    """Raise a ValueError for a picture given twice: it would count as independent evidence."""
    first: dict[bytes, int] = {}
    for k, picture in enumerate(pictures):
        points = picture.edge_points.pixels.tobytes()
        if points and first.setdefault(points, k) != k:
            raise ValueError(f"views {first[points]} and {k}: the same picture, given twice")


def _own_command(views: SeenViews) -> Command:
    """Return the reported poses of the views, without padding, on the host."""
    count = len(views.camera_from_world)
    return jax.tree.map(lambda x: np.asarray(x)[:count], views.command)


def _joined_commands(first: Command, second: Command) -> Command:
    """Return two batches of commands as one, with joint readings where both have them."""
    if first.joints is None or second.joints is None:
        first, second = Command(first.base_from_tool), Command(second.base_from_tool)
    return jax.tree.map(lambda a, b: np.concatenate([a, b]), first, second)


def _check_models(
    hypotheses: Sequence[Hypothesis] | None, previous: Localizations | None, count: int
) -> None:
    """Raise a ValueError for a hypothesis or an earlier result of an unknown model."""
    given = [h.model for h in hypotheses or ()]
    earlier = [result.model_index for result in previous or ()]
    for name, indices in (("hypotheses", given), ("previous", earlier)):
        unknown = [k for k in indices if not 0 <= k < count]
        if unknown:
            raise ValueError(f"{name}: of model {unknown[0]}, where there are {count} models")


def _hypotheses_of(previous: Localizations | None) -> list[Hypothesis]:
    """Return every pose that earlier views left open or accepted, rivals included."""
    kept = [result for result in previous or () if result.verdict.decision != "rejected"]
    poses = [(result.model_index, result.world_from_object) for result in kept]
    poses += [(rival.model, rival.world_from_object) for result in kept for rival in result.rivals]
    return [Hypothesis(model, pose, 0.0, 0.0) for model, pose in poses]


def _searched(
    pictures: Sequence[PictureEvidence],
    views: SeenViews,
    prepared: Sequence[Prepared],
    known: set[int],
    box: Float[np.ndarray, "2 3"] | None,
) -> list[Hypothesis]:
    """Return hypotheses of the models not known yet, with their indices among all models."""
    missing = [k for k in range(len(prepared)) if k not in known]
    if not missing:
        return []
    models = [prepared[k].model for k in missing]
    hypotheses = find_hypotheses(pictures, views, models, workspace=box)
    return [h._replace(model=missing[h.model]) for h in hypotheses]


def _reported(results: Sequence[Localization]) -> list[Localization]:
    """Return accepted and open results, and the best rejected one of each model without any."""
    # A rejected pose is reported only where there is no better one: its evidence says why.
    order = {"accepted": 0, "open": 1, "rejected": 2}
    kept = [result for result in results if result.verdict.decision != "rejected"]
    for result in results:
        if result.model_index not in {other.model_index for other in kept}:
            kept.append(result)
    return sorted(kept, key=lambda result: order[result.verdict.decision])


def _messages(
    prepared: Sequence[Prepared],
    found: Sequence[Localization],
    hypotheses: Sequence[Hypothesis],
) -> tuple[str, ...]:
    """Return the reason for every model that was not accepted."""
    messages = []
    for index, entry in enumerate(prepared):
        results = [result for result in found if result.model_index == index]
        if any(result.accepted for result in results):
            continue
        name = model_name(entry.model, index)
        undecided = [result for result in results if result.verdict.decision == "open"]
        if undecided:
            messages += [result.message for result in undecided]
        elif results:
            messages.append(f"{name}: not found: {'; '.join(results[0].verdict.reasons)}")
        else:
            tried = sum(h.model == index for h in hypotheses)
            messages.append(f"{name}: not found: {tried} hypotheses, none with enough edges")
    return tuple(messages)
