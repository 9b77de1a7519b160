"""Compare calibration methods: the paper's methods, and the joint fit."""

from collections.abc import Callable, Mapping
from typing import Any, Unpack, overload

from ...calibration import Calibration
from ...calibration_pipeline import DEFAULT_LENS, calibrate
from ...cameras import AbstractLens, Camera
from ...dataset import Dataset, Rig
from ...geometry import PoseLike
from ...joint import JointOptions
from ...staged import fit_one_view_intrinsics, fit_staged
from ..free_poses import free_pose_errors
from .folds import split_views
from .methods import FoldedFits, Method, MethodResult, folded_fits, rows_of_method
from .rig_compare import RigMethod, compare_rig


def standard_methods(
    lens: str | AbstractLens = DEFAULT_LENS,
    *,
    camera: Camera | None = None,
    start: Calibration | Mapping[str, PoseLike] | None = None,
    **joint_options: Unpack[JointOptions],
) -> dict[str, Method]:
    """Return the paper's methods, the joint fit, and the lower bound of a free pose per view.

    Args:
        lens: lens model of all methods except the one without distortion.
        camera: a known camera; methods about estimating the camera are then left out.
        start: start of the joint fits, as for `calibrate`.
        joint_options: options of the joint fits, except the noise model, which each method sets.
    """

    def calibrate_estimated(data: Dataset) -> Any:
        return calibrate(data, lens, camera=camera, start=start, **joint_options)

    def calibrate_trusted(data: Dataset) -> Any:
        options: JointOptions = {**joint_options, "noise": "trusted"}
        return calibrate(data, lens, camera=camera, start=start, **options)

    methods = {
        "staged": Method(calibrate_trusted, lambda fit, _: fit.staged),
        "staged, no distortion": Method(lambda data: fit_staged(data, lens="pinhole")),
        "linear interpolation": Method(
            calibrate_trusted, lambda fit, data: fit.staged.interpolation(data)
        ),
        "one view's intrinsics": Method(fit_one_view_intrinsics),
        "joint, robot trusted": Method(calibrate_trusted),
        "joint, errors estimated": Method(calibrate_estimated),
        "free pose a view": Method(calibrate_trusted, measure=free_pose_errors),
    }
    if camera is not None:
        # These two are about estimating the camera.
        del methods["staged, no distortion"], methods["one view's intrinsics"]
    return methods


@overload
def compare(
    data: Dataset,
    methods: Mapping[str, Method | Callable[[Dataset], Any]] | None = None,
    folds: int = 5,
    progress: Callable[[str], None] | None = None,
    by: str = "view",
) -> list[MethodResult]: ...


@overload
def compare(
    data: Rig,
    methods: Mapping[str, RigMethod | Callable[[Rig], Any]] | None = None,
    folds: int = 5,
    progress: Callable[[str], None] | None = None,
    by: str = "view",
) -> dict[str, list[MethodResult]]: ...


def compare(
    data: Dataset | Rig,
    methods: Mapping[str, Any] | None = None,
    folds: int = 5,
    progress: Callable[[str], None] | None = None,
    by: str = "view",
) -> list[MethodResult] | dict[str, list[MethodResult]]:
    """Fit every method to all views and in every fold; the folds are the same for all methods.

    A fit that corrects the robot's error gets a second row without the correction, for programs
    that use only its transforms. These are the best estimate of the mount, but do not predict best
    without the correction: for this, use a fit that trusts the robot, whose transforms absorb its
    error.

    Args:
        data: all views. Of a `Rig`, folds hide states of the robot from all cameras at once.
        methods: methods by name: a `Method`, or a fitter as for `held_out`; by default
            `standard_methods()`. Of a rig, a `RigMethod` or a fitter; by default
            `standard_rig_methods()`, which fit each camera alone and all together.
        folds: number of folds; below eight views, as many as there are views.
        progress: called with a line of text for each fit.
        by: `"view"` or `"region"`, as for `held_out`.

    Returns:
        A row for each method, or two; of a rig, the rows of each camera by its name.

    Raises:
        ValueError: fewer than two folds, or too few usable views.

    For example:

        >>> def joint(part):
        ...     return sv.fit_joint(part, truth, noise=noise)
        >>> for row in sv.compare(data, {"joint": joint}, folds=4):
        ...     print(row.name, f"{row.held_out.errors.rms:.1f} px")
        joint 1.6 px

    Of a rig, here with one camera in the place of two:

        >>> rig = sv.Rig({"left": data, "right": data.select(range(4))})
        >>> def rig_fitter(part):
        ...     return sv.fit_rig(part, {"left": truth, "right": truth}, noise=noise)
        >>> for row in sv.compare(rig, {"together": rig_fitter}, folds=4)["right"]:
        ...     print(row.name, f"{row.held_out.errors.rms:.1f} px")
        together 1.7 px
    """
    if isinstance(data, Rig):
        return compare_rig(data, methods, folds, progress, by)
    report = progress or (lambda _: None)
    split = split_views(data, folds, by)
    # By fitter: its fits, or the error of its fit to all views.
    fits: dict[Callable, FoldedFits | ValueError] = {}
    results = []
    for name, method_or_fitter in (standard_methods() if methods is None else methods).items():
        method = (
            method_or_fitter if isinstance(method_or_fitter, Method) else Method(method_or_fitter)
        )
        # Methods with the same fitter are parts of one fit: it runs once per fold for all of them.
        if method.fitter not in fits:
            report(name)
            fits[method.fitter] = folded_fits(
                data, method.fitter, split, lambda s, n=name: report(f"{n}: {s}")
            )
        results += rows_of_method(name, method, fits[method.fitter], data)
    return results
