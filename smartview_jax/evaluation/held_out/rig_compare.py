"""Compare methods on a rig: each camera fitted alone, and all cameras together."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from ...calibration_pipeline import DEFAULT_LENS, calibrate
from ...cameras import AbstractLens
from ...dataset import Dataset, Rig
from ..free_poses import free_pose_errors
from ..measures import ReprojectionErrors, reprojection_errors
from .folds import split_views
from .held_out import camera_of_rig, camera_views, folds_of_camera, whole_fit
from .methods import FoldedFits, Method, MethodResult, folded_fits, rows_of_method


class RigMethod(NamedTuple):
    """A method of the comparison on a rig.

    Attributes:
        fitter: function from a rig to a `RigFit`, or, if each camera is fitted alone, from a data
            set to a fit. Methods with the same fitter use the same fits.
        alone: whether the fitter fits one camera.
        choose: function from a fit of one camera, and its data, to the part that is scored.
        measure: function from a predictor and a camera's data to reprojection errors.
    """

    fitter: Callable[[Any], Any]
    alone: bool = False
    choose: Callable[[Any, Dataset], Any] = whole_fit
    measure: Callable[[Any, Dataset], ReprojectionErrors] = reprojection_errors


def standard_rig_methods(lens: str | AbstractLens = DEFAULT_LENS) -> dict[str, RigMethod]:
    """Return the staged and the joint fit of each camera alone, and the fit of all together.

    The last row is the lower bound of a free pose per view, as in `standard_methods`.

    Args:
        lens: lens model of all cameras.
    """

    def one_camera(data: Dataset) -> Any:
        return calibrate(data, lens)

    def all_cameras(rig: Rig) -> Any:
        return calibrate(rig, lens)

    return {
        "staged, each camera alone": RigMethod(one_camera, True, lambda fit, _: fit.staged),
        "joint, each camera alone": RigMethod(one_camera, True),
        "joint, all cameras together": RigMethod(all_cameras),
        "free pose a view": RigMethod(all_cameras, measure=free_pose_errors),
    }


def compare_rig(
    rig: Rig,
    methods: Mapping[str, RigMethod | Callable[[Rig], Any]] | None,
    folds: int,
    progress: Callable[[str], None] | None,
    by: str,
) -> dict[str, list[MethodResult]]:
    """Return the rows of each camera; `compare` calls it for a rig and explains the arguments."""
    report, split = progress or (lambda _: None), split_views(rig, folds, by)
    # By fitter: the fits of each camera, or the errors of its fit to all views.
    fits: dict[Callable, dict[str, FoldedFits | ValueError]] = {}
    rows: dict[str, list[MethodResult]] = {camera: [] for camera in rig.cameras}
    for name, given in (standard_rig_methods() if methods is None else methods).items():
        method = given if isinstance(given, RigMethod) else RigMethod(given)
        if method.fitter not in fits:
            report(name)
            fit_all = _fits_alone if method.alone else _fits_together
            fits[method.fitter] = fit_all(
                rig, method.fitter, split, lambda s, n=name: report(f"{n}: {s}")
            )
        of_camera = Method(method.fitter, method.choose, method.measure)
        for camera, data in rig.cameras.items():
            rows[camera] += rows_of_method(name, of_camera, fits[method.fitter][camera], data)
    return rows


def _fits_alone(
    rig: Rig,
    fitter: Callable[[Dataset], Any],
    split: tuple[tuple[int, ...], ...],
    progress: Callable[[str], None],
) -> dict[str, FoldedFits | ValueError]:
    """Fit each camera by itself, in the folds of the rig."""
    return {
        name: folded_fits(
            data,
            fitter,
            tuple(camera_views(rig, name, states) for states in split),
            lambda text, camera=name: progress(f"{camera}: {text}"),
        )
        for name, data in rig.cameras.items()
    }


def _fits_together(
    rig: Rig,
    fitter: Callable[[Rig], Any],
    split: tuple[tuple[int, ...], ...],
    progress: Callable[[str], None],
) -> dict[str, FoldedFits | ValueError]:
    """Fit all cameras of the rig at once, and return the part of each."""
    folded = folded_fits(rig, fitter, split, progress)
    if isinstance(folded, ValueError):
        return dict.fromkeys(rig.cameras, folded)
    return {
        name: FoldedFits(camera_of_rig(folded.fit, name), folds_of_camera(folded.refits, rig, name))
        for name in rig.cameras
    }
