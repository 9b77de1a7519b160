"""Find known objects in calibrated pictures, with a verdict and a covariance for each.

Hypotheses are refined on the pictures' edges, ranked by the visible edge length that they explain,
and judged one after the other: edge points that one object explains are no evidence for the next.
The poses of accepted objects are refined together at the end.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float

from ..cameras import Camera
from ..engine import Noise
from ..evaluation import CalibrationEstimate
from ..features import PictureEvidence, picture_evidence, scaled_camera
from ..modeling import AnyCalibration, CalibrationUncertainty, ObjectModel, RigViews, SeenViews
from ..robots import CommandLike
from .corrected_rig import judged_with_rig
from .earlier_views import own_command, together_with
from .edges import checked_triangles, shows
from .judging import (
    DEFAULT_OPTIONS,
    MAX_REJECTED,
    Localization,
    Localizations,
    Prepared,
    Query,
    Scene,
    VerdictOptions,
    model_name,
)
from .refining import THREADS
from .refining_together import refined_together
from .search import DEFAULT_SEARCH_OPTIONS, Hypothesis, SearchOptions, at_one_scale, checked_box
from .search_rounds import SearchResult, hypotheses_of, judged_in_rounds


def localize(
    pictures_or_features: Sequence[np.ndarray | PictureEvidence],
    poses: CommandLike | None,
    calibration: AnyCalibration,
    models: ObjectModel | Sequence[ObjectModel],
    *,
    covariance: CalibrationEstimate | None = None,
    noise: Noise | None = None,
    previous: Localizations | None = None,
    hypotheses: Sequence[Hypothesis] | None = None,
    workspace: Float[np.ndarray, "2 3"] | None = None,
    occluders: Float[np.ndarray, "triangles 3 3"] | None = None,
    options: VerdictOptions = DEFAULT_OPTIONS,
    search: SearchOptions = DEFAULT_SEARCH_OPTIONS,
) -> Localizations:
    """Find objects of known models in one, two or more calibrated pictures.

    Args:
        pictures_or_features: uint8 pictures, or the result of `picture_evidence` for each; one a
            view.
        poses: poses that the robot reported in each view, `base_from_tool`; None for cameras next
            to the arm whose results are in the base frame (`RigViews`).
        calibration: the calibrated camera; poses of objects are in its world frame. For pictures of
            several cameras, such as a stereo pair, `RigViews` that name the camera of each.
        models: models of the objects that may be there, any number of each.
        covariance: a joint fit, or a bound, with the uncertainty of the calibration; None takes the
            calibration as exact. `RigViews` of a rig's fit have its joint covariance.
        noise: sizes of the robot's noise in these views; by default the noise of the fit.
        previous: result for earlier views of the same scene. Their pictures are used together with
            the new ones, and every pose that is accepted, open or a rival is judged again. Models
            without such a pose are searched again in all pictures. It must have been found with the
            same calibration, or with cameras of the same rig: each earlier picture is read again
            with the camera that took it.
        hypotheses: initial poses; by default they are searched in the pictures.
        workspace: two opposite corners of a box in the world, m, that contains the objects, such as
            a bin; nothing outside is found. None for anywhere.
        occluders: triangles in the world, m, of known obstacles such as the walls of a bin; edges
            that they occlude do not count as missing.
        options: limits by which a pose is accepted, rejected or left open.
        search: limits of the search for poses.

    Returns:
        The objects found, accepted ones first; `messages` says why others were not accepted.

    Raises:
        ValueError: no views, numbers of poses and pictures that differ, a picture that is not of
            its camera's size, has no usable edges or is given twice, a model without edges, a
            workspace that is not a box, occluders that are not triangles, a hypothesis of an
            unknown model, or `previous` found with another calibration; the message names the view,
            model or argument.

    For example:

        >>> views = sv.io.load_object_views(sv.io.object_sample_folder() / "object")
        >>> block = sv.simulation.stepped_block(0.026).exact_model("block")
        >>> poses = sv.geometry.host_matrices(views.base_from_tool)
        >>> search = views.pictures[:3], poses[:3], truth, block
        >>> sv.localize(*search).accepted[0].world_from_object.round(3)  # doctest: +SKIP
        array([[ 0.877, -0.48 ,  0.   ,  0.018],
               [ 0.48 ,  0.877,  0.   , -0.013],
               [-0.   ,  0.   ,  1.   , -0.   ],
               [ 0.   ,  0.   ,  0.   ,  1.   ]])
    """
    prepared, triangles = _prepared(models), checked_triangles(occluders)
    box = None if workspace is None else checked_box(workspace)
    _check_models(hypotheses, previous, len(prepared))
    views = _checked_views(pictures_or_features, poses, calibration)
    # OpenCV and NumPy release the interpreter lock, so that pictures are searched in parallel.
    with ThreadPoolExecutor(THREADS) as pool:
        count = len(pictures_or_features)
        found_in = pool.map(_evidence, range(count), pictures_or_features, views.cameras)
        pictures = tuple(found_in)
    if previous is not None:
        calibration, command = together_with(previous, calibration, own_command(views))
        pictures = (*previous.pictures, *pictures)
        views = SeenViews.of(calibration, command)
    uncertainty = CalibrationUncertainty.of(views, calibration, covariance, noise)
    given_views = views
    pictures, views = at_one_scale(pictures, given_views)
    uncertainty = uncertainty.resized(given_views, views)
    _check_distinct(pictures)
    # With earlier results only their remaining poses are judged in the new views, without a
    # search.
    given, missing = list(hypotheses or ()), list[int]()
    if hypotheses is None:
        given = hypotheses_of([r for r in previous or () if r.verdict.decision != "rejected"])
        known = {h.model for h in given}
        missing = [k for k in range(len(prepared)) if k not in known]
    scene = Scene(views, pictures, triangles)
    query = Query(prepared, uncertainty, options, box, search=search)
    searched = judged_in_rounds(scene, query, given, missing)
    searched, scene, query = judged_with_rig(searched, scene, query, missing)
    results = refined_together(searched.results, scene, prepared, query.uncertainty)
    frame = calibration.frame if isinstance(calibration, RigViews) else "world"
    return Localizations(
        [result._replace(frame=frame) for result in _reported(results)],
        _messages(prepared, searched),
        pictures,
        own_command(views),
        calibration,
    )


def _prepared(models: ObjectModel | Sequence[ObjectModel]) -> list[Prepared]:
    """Return models with their wireframes."""
    given = [models] if isinstance(models, ObjectModel) else list(models)
    if not given:
        raise ValueError("models: expected at least one, found none")
    for k, model in enumerate(given):
        if not shows(model):
            raise ValueError(f"models: model {k} {model.name!r} has no edges, nothing to look for")
    return [Prepared.of(model) for model in given]


def _checked_views(
    pictures: Sequence[np.ndarray | PictureEvidence],
    poses: CommandLike | None,
    calibration: AnyCalibration,
) -> SeenViews:
    """Return the views, after checking that each picture has a pose."""
    if isinstance(pictures, np.ndarray | PictureEvidence) or not len(pictures):
        raise ValueError("pictures: expected a list of pictures, one for each view")
    if not isinstance(calibration, AnyCalibration):
        kind = type(calibration).__name__
        raise ValueError(
            "calibration: expected a Calibration, such as fit.calibration, or RigViews that name "
            f"the camera of each picture; found {kind}"
        )
    if isinstance(calibration, RigViews) and len(calibration) != len(pictures):
        raise ValueError(
            f"calibration: {len(pictures)} pictures, but RigViews name the cameras of "
            f"{len(calibration)} views"
        )
    views = SeenViews.of(calibration, poses)
    count = len(views.camera_from_world)
    if count != len(pictures):
        raise ValueError(
            f"poses: {len(pictures)} pictures and {count} poses; view {min(count, len(pictures))} "
            "has only one of them, so it is not calibrated"
        )
    return views


def _evidence(view: int, picture: np.ndarray | PictureEvidence, camera: Camera) -> PictureEvidence:
    """Return the edges, corners and segments of a view's picture."""
    if isinstance(picture, PictureEvidence):
        expected = scaled_camera(camera, picture.scale).image_size
        if picture.features.image_size != expected:
            size, wanted = ("x".join(map(str, s)) for s in (picture.features.image_size, expected))
            raise ValueError(f"view {view}: evidence of a picture of {size} px, expected {wanted}")
        return picture
    if not isinstance(picture, np.ndarray):
        raise ValueError(
            f"view {view}: expected a picture, or what picture_evidence found in it; found "
            f"{type(picture).__name__}"
        )
    try:
        return picture_evidence(picture, camera)
    except ValueError as error:
        raise ValueError(f"view {view}: {error}") from None


def _check_distinct(pictures: Sequence[PictureEvidence]) -> None:
    """Raise a ValueError for a picture given twice: it would count as independent evidence."""
    first: dict[bytes, int] = {}
    for k, picture in enumerate(pictures):
        points = picture.edge_points.pixels.tobytes()
        if points and first.setdefault(points, k) != k:
            raise ValueError(f"views {first[points]} and {k}: the same picture, given twice")


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


def _reported(results: Sequence[Localization]) -> list[Localization]:
    """Return accepted and open results, and the best rejected one of each model without any."""
    # A rejected pose is reported only where there is no better one: its evidence says why.
    order = {"accepted": 0, "open": 1, "rejected": 2}
    kept = [result for result in results if result.verdict.decision != "rejected"]
    for result in results:
        if result.model_index not in {other.model_index for other in kept}:
            kept.append(result)
    return sorted(kept, key=lambda result: order[result.verdict.decision])


def _messages(prepared: Sequence[Prepared], searched: SearchResult) -> tuple[str, ...]:
    """Return the reason for every model that was not accepted, and where the search ended early."""
    messages = []
    for index, entry in enumerate(prepared):
        results = [result for result in searched.results if result.model_index == index]
        name, unjudged = model_name(entry.model, index), searched.unjudged[index]
        undecided = [result for result in results if result.verdict.decision == "open"]
        if any(result.accepted for result in results):
            pass
        elif undecided:
            messages += [result.message for result in undecided]
        elif results:
            messages.append(f"{name}: not found: {'; '.join(results[0].verdict.reasons)}")
        else:
            messages.append(
                f"{name}: not found: {searched.tried[index]} hypotheses, none with enough edges"
            )
        if unjudged:
            messages.append(
                f"{name}: the search ended after {MAX_REJECTED} rejected poses in a row; "
                f"{unjudged} more were not judged"
            )
    return tuple(messages)
