"""Divide views by their cameras, where pictures of some were resized or cut.

A first camera is fitted to views that agree with each other, and a second one to the views that the
first does not fit. A picture that shows the target from the front fits both, so that in the end
each view is of the camera with which it agrees with the robot. A known camera is the first one, and
the second one is the same with another size and shift of its pictures.
"""

from collections.abc import Iterator

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool

from ..cameras import Camera
from ..data_checks import CameraMisfit, ResizedPictures, TwoCameras, find_resized_pictures
from ..geometry import host_matrices
from ..runtime.array_namespace import to_device
from ..runtime.modules import with_fields
from .common_camera import PictureFit
from .picture_steps import Step1, run_step1, start_of_step2
from .resized_camera import fit_resized_camera

MIN_VIEWS = 4
"""Smallest number of views of a part: three may be fitted by many cameras."""

MAX_DIFFERENCE = 5.0
"""Largest difference of a view's focal length from the median, in its standard deviations, with
which a view may have the camera of most views."""

MAX_RMS_RATIO = 3.0
"""Reprojection error of a view, over the median one of the views to which a camera was fitted, up
to which it may have the same camera."""


def resized_pictures(
    pictures: PictureFit, mount_from_holder: SE3, first_view: int, misfit: CameraMisfit | None
) -> ResizedPictures | None:
    """Return the views whose pictures seem to be resized or cut; None if there are none.

    Args:
        pictures: Steps 1 and 2 with one camera for all views.
        mount_from_holder: the robot's part of the chain, `(views)`.
        first_view: index of the first view after a change that robot and camera tell; 0 for none.
        misfit: how badly one camera fits all views; None if it fits.
    """
    if pictures.steps.camera is None:
        masks = _agreeing_views(pictures, first_view)
        pairs = (_two_cameras(pictures, agreeing, misfit) for agreeing in masks)
    else:
        masks = _resized_views(pictures, misfit)
        pairs = (_known_and_resized(pictures, pictures.steps.camera, others) for others in masks)
    reports = (
        find_resized_pictures(
            mount_from_holder, pictures.common.camera_from_world, pictures.used, cameras
        )
        for cameras in pairs
        if cameras is not None
    )
    named = (report for report in reports if report is not None)
    # With a known camera the robot divides the views, whichever of them told the size.
    if pictures.steps.camera is not None:
        return next(named, None)
    return min(named, key=lambda report: report.score, default=None)


def _agreeing_views(pictures: PictureFit, first_view: int) -> Iterator[Bool[np.ndarray, "views"]]:
    """Yield masks of views that may have one camera, enough to fit it."""
    used, step1 = pictures.used, pictures.step1.calibrations
    assert step1 is not None
    logarithms = np.log(np.asarray(step1.intrinsics.alpha_u))
    errors = np.where(used, np.asarray(step1.alpha_relative_std), np.inf)
    far = np.abs(logarithms - np.median(logarithms[used])) > MAX_DIFFERENCE * errors
    # A camera that does not fit leaves a large error; and from the front no view tells any.
    best = np.argsort(np.where(far, np.inf, errors))[: max(np.count_nonzero(used) // 2, MIN_VIEWS)]
    alike = np.isin(np.arange(len(used)), best) & used & ~far
    later = np.arange(len(used)) >= first_view
    for mask in (alike, used & later, used & ~later):
        if mask.sum() >= MIN_VIEWS and not (mask == used).all():
            yield mask


def _two_cameras(
    pictures: PictureFit, agreeing: Bool[np.ndarray, "views"], misfit: CameraMisfit | None
) -> TwoCameras | None:
    """Return the camera of views that agree, and another one of the views that it does not fit.

    Returns:
        None if it fits all views, or if two cameras do not fit either, as with a wrong lens.
    """
    camera, seen = _camera_of(pictures, agreeing)
    limit = MAX_RMS_RATIO * float(np.median(seen.rms[agreeing]))
    others = pictures.used & ~(seen.rms <= limit)
    if others.sum() < MIN_VIEWS:
        return None
    other_camera, seen_by_other = _camera_of(pictures, others)
    rms = np.median(np.fmin(seen.rms, seen_by_other.rms)[pictures.used])
    if misfit is not None and not misfit.is_answered_by(float(rms / np.sqrt(2.0))):
        return None
    return _divided((camera, other_camera), (seen, seen_by_other), others)


def has_views_of_other_camera(pictures: PictureFit) -> bool:
    """Return whether a known camera fits some of the views far worse than most."""
    return pictures.steps.camera is not None and bool(_unlike_most(pictures).any())


def _unlike_most(pictures: PictureFit) -> Bool[np.ndarray, "views"]:
    """Return the views that a known camera fits far worse than the half that it fits best."""
    best = pictures.used & ~_worst_half(pictures)
    return _far_above(pictures, float(np.median(pictures.step1.rms[best])))


def _worst_half(pictures: PictureFit) -> Bool[np.ndarray, "views"]:
    """Return the half of the views that a known camera fits worst, without the `MIN_VIEWS` best."""
    used = np.flatnonzero(pictures.used)
    order = used[np.argsort(pictures.step1.rms[used])]
    return np.isin(np.arange(len(pictures.used)), order[max(len(used) // 2, MIN_VIEWS) :])


def _far_above(pictures: PictureFit, rms: float) -> Bool[np.ndarray, "views"]:
    """Return the views in which a known camera leaves far more than an error, px."""
    return pictures.used & ~(pictures.step1.rms <= MAX_RMS_RATIO * rms)


def _resized_views(
    pictures: PictureFit, misfit: CameraMisfit | None
) -> Iterator[Bool[np.ndarray, "views"]]:
    """Yield masks of views that may not be as a known camera took them, enough to find their size.

    They are those that the camera fits far worse than most, or than a camera of its own would fit
    each. Where most pictures were resized, and only a little, those that it fits worst are.
    """
    masks = [_unlike_most(pictures), _worst_half(pictures)]
    if misfit is not None:
        masks.append(_far_above(pictures, misfit.single_rms))
    for mask in masks:
        if mask.any() and not (mask == pictures.used).all():
            yield mask


def _known_and_resized(
    pictures: PictureFit, known: Camera, others: Bool[np.ndarray, "views"]
) -> TwoCameras:
    """Return a known camera, and the same for other views, resized and shifted."""
    resized = fit_resized_camera(known, pictures.observations, others, pictures.steps.lens)
    seen_by_other = run_step1(
        pictures.observations, known.image_size, pictures.used, pictures.steps.lens, resized
    )
    return _divided((known, resized), (pictures.step1, seen_by_other), others, True)


def _divided(
    cameras: tuple[Camera, Camera],
    seen: tuple[Step1, Step1],
    of_second: Bool[np.ndarray, "views"],
    is_first_known: bool = False,
) -> TwoCameras:
    """Return both cameras with the poses of the views by either; see `TwoCameras`."""
    poses = np.stack([host_matrices(step.camera_from_world) for step in seen])
    return TwoCameras(cameras, poses, of_second, is_first_known)


def _camera_of(pictures: PictureFit, part: Bool[np.ndarray, "views"]) -> tuple[Camera, Step1]:
    """Return the camera of a part of the views (Step 2), and all views as seen with it."""
    observations, steps, step1 = pictures.observations, pictures.steps, pictures.step1
    assert step1.calibrations is not None
    size = step1.camera.image_size
    assert size is not None
    start, poses = start_of_step2(step1.calibrations, part, steps.lens, size)
    of_part = with_fields(observations, visible=np.asarray(observations.visible) & part[:, None])
    inliers = to_device(np.asarray(pictures.start_inliers) & part[:, None])
    camera = steps.common(of_part, start, poses, inliers).camera
    return camera, run_step1(observations, size, pictures.used, steps.lens, camera)
