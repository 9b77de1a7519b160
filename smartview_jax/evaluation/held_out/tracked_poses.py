"""Cross-validate a fit to tracked poses: the errors of pairs that the fit never used."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...dataset import PoseDataset
from ...joint import PoseFit, pose_rms, tracked_pose_errors
from .held_out import fit_folds


class HeldOutPoses(NamedTuple):
    """The errors of fits on pairs of poses that they never used.

    Attributes:
        errors: distance (m) and angle (rad) of each tracked pose from its prediction; NaN for
            pairs that were not seen or whose fold failed.
        folds: indices of the views held out in each fold.
        failures: fold and reason, for folds whose fit failed.
    """

    errors: Float[np.ndarray, "views 2"]
    folds: tuple[tuple[int, ...], ...]
    failures: tuple[tuple[int, str], ...]

    @property
    def rms(self) -> tuple[float, float]:
        """RMS distance (m) and angle (rad); NaN if no fold succeeded."""
        scored = self.errors[np.isfinite(self.errors).all(axis=1)]
        return pose_rms(scored) if len(scored) else (float("nan"), float("nan"))


def held_out_poses(
    data: PoseDataset,
    fitter: Callable[[PoseDataset], PoseFit],
    folds: int = 5,
    progress: Callable[[str], None] | None = None,
) -> HeldOutPoses:
    """Cross-validate by view.

    Args:
        data: all pairs, without those that are known to be wrong (`without_rejected_views`).
        fitter: function from a data set to a fit, called with the held-out views masked.
        folds: number of folds; below eight views, as many as there are views.
        progress: called with a line of text for each fold.

    Raises:
        ValueError: fewer than two folds or four usable views.
    """
    fits = fit_folds(data, fitter, folds, progress)
    errors = np.full((data.view_count, 2), np.nan)
    for fold in fits:
        if fold.fit is not None:
            views = list(fold.views)
            errors[views] = tracked_pose_errors(data, fold.fit.calibration)[views]
    failures = tuple((k, fold.failure) for k, fold in enumerate(fits) if fold.failure is not None)
    return HeldOutPoses(errors, tuple(fold.views for fold in fits), failures)
