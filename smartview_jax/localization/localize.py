"""Find known objects in calibrated pictures, and say how certain each is.

Hypotheses are drawn to the pictures' edges, ranked by the visible edge length that they explain,
and judged one after the other: what an object explains is no evidence for the next. The poses of
those that are accepted are refined together at the end.
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
        pictures_or_features: uint8 pictures, or what `picture_evidence` found in them; one a view.
        poses: what the robot reported in each view, `base_from_tool`.
        calibration: the calibrated camera; poses of objects are in its world frame.
        models: of the objects that may be there, any number of each.
        covariance: a joint fit, or a bound, that states how well the calibration is known; None
            takes it as exact.
        noise: sizes of the robot's noise in these views; by default that of the fit.
        previous: what was found in earlier views of the same scene. Their pictures count together
            with the new ones, and every pose that is accepted, open or a rival is judged anew.
            Models of which there is none are searched for again, in all pictures.
        hypotheses: poses to begin from instead of those that are searched for.
        workspace: two opposite corners of a box in the world, m, in which objects are, as of a bin;
            what is not there is not found. None for anywhere.
        occluders: triangles in the world, m, of what is known to stand there, such as the walls of
            a bin: what they hide is not held against a pose.

    Returns:
        What was found, accepted ones first; `messages` says why the others were not.

    Raises:
        ValueError: no views, a number of poses that is not that of the pictures, a model without
            edges, a picture on which nothing can be found or that is given twice, a workspace that
            is not a box, occluders that are not triangles, or a hypothesis of a model that is not
            there; the message names the view, model or argument.
    """
    prepared, triangles = _prepared(models), checked_triangles(occluders)
    box = None if workspace is None else checked_box(workspace)
    _check_models(hypotheses, previous, len(prepared))
    views = _checked_views(pictures_or_features, poses, calibration)
    # OpenCV and NumPy release the interpreter lock, so that pictures are searched side by side.
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
    # A further view is asked about the poses that are left: for these nothing is searched anew.
    left = _hypotheses_of(previous) if hypotheses is None else list(hypotheses)
    if hypotheses is None:
        left += _searched(pictures, views, prepared, {one.model for one in left}, box)
    scene = Scene(views, pictures, triangles)
    candidates = converged_candidates(scene, prepared, left)
    # Checked again after the fit, which may have drawn a pose out of the box. That its middle is
    # inside is enough: its vertices were checked when it was proposed, and a wall may err.
    if box is not None:
        middles = [prepared[one.model].middle_at(one.pose) for one in candidates]
        inside = [bool(((box[0] <= m) & (m <= box[1])).all()) for m in middles]
        candidates = [one for one, is_in in zip(candidates, inside, strict=True) if is_in]
    found = judged(scene, prepared, candidates, uncertainty, len(left))
    found = refined_together(found, scene, prepared, uncertainty)
    return Localizations(
        _reported(found), _messages(prepared, found, left), pictures, _own_command(views)
    )


def _prepared(models: ObjectModel | Sequence[ObjectModel]) -> list[Prepared]:
    """Return models with their wireframes."""
    given = [models] if isinstance(models, ObjectModel) else list(models)
    if not given:
        raise ValueError("models: expected at least one, found none")
    for k, one in enumerate(given):
        if not len(one.edges):
            raise ValueError(f"models: model {k} {one.name!r} has no edges, nothing to look for")
    return [Prepared.of(one) for one in given]


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
    """Return what is found in the picture of a view."""
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
    """Raise a ValueError where two pictures are one: the second would be counted as a witness."""
    first: dict[bytes, int] = {}
    for k, one in enumerate(pictures):
        points = one.edge_points.pixels.tobytes()
        if points and first.setdefault(points, k) != k:
            raise ValueError(f"views {first[points]} and {k}: the same picture, given twice")


def _own_command(views: SeenViews) -> Command:
    """Return what the robot reported in the views, without padding, on the host."""
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
    """Raise a ValueError where a hypothesis, or what was found before, is of an unknown model."""
    given = [one.model for one in hypotheses or ()]
    found = [one.model_index for one in previous or ()]
    for name, indices in (("hypotheses", given), ("previous", found)):
        unknown = [k for k in indices if not 0 <= k < count]
        if unknown:
            raise ValueError(f"{name}: of model {unknown[0]}, where there are {count} models")


def _hypotheses_of(previous: Localizations | None) -> list[Hypothesis]:
    """Return every pose that earlier views left, rivals included."""
    left = [one for one in previous or () if one.verdict.decision != "rejected"]
    poses = [(one.model_index, one.world_from_object) for one in left]
    poses += [(rival.model, rival.world_from_object) for one in left for rival in one.rivals]
    return [Hypothesis(model, pose, 0.0, 0.0) for model, pose in poses]


def _searched(
    pictures: Sequence[PictureEvidence],
    views: SeenViews,
    prepared: Sequence[Prepared],
    known: set[int],
    box: Float[np.ndarray, "2 3"] | None,
) -> list[Hypothesis]:
    """Return hypotheses of the models that are not known, by their indices among all."""
    missing = [k for k in range(len(prepared)) if k not in known]
    if not missing:
        return []
    models = [prepared[k].model for k in missing]
    found = find_hypotheses(pictures, views, models, workspace=box)
    return [one._replace(model=missing[one.model]) for one in found]


def _reported(found: Sequence[Localization]) -> list[Localization]:
    """Return accepted and open ones, and the best rejected one of each model without any."""
    # A rejected pose is reported only where nothing better is: its evidence says why.
    order = {"accepted": 0, "open": 1, "rejected": 2}
    kept = [one for one in found if one.verdict.decision != "rejected"]
    for one in found:
        if one.model_index not in {other.model_index for other in kept}:
            kept.append(one)
    return sorted(kept, key=lambda one: order[one.verdict.decision])


def _messages(
    prepared: Sequence[Prepared],
    found: Sequence[Localization],
    hypotheses: Sequence[Hypothesis],
) -> tuple[str, ...]:
    """Return, for every model that was not accepted, why."""
    messages = []
    for index, one in enumerate(prepared):
        own = [each for each in found if each.model_index == index]
        if any(each.accepted for each in own):
            continue
        name = model_name(one.model, index)
        undecided = [each for each in own if each.verdict.decision == "open"]
        if undecided:
            messages += [each.message for each in undecided]
        elif own:
            messages.append(f"{name}: not found: {'; '.join(own[0].verdict.reasons)}")
        else:
            tried = sum(h.model == index for h in hypotheses)
            messages.append(f"{name}: not found: {tried} hypotheses, none with enough edges")
    return tuple(messages)
