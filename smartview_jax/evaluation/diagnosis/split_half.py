"""Test whether two halves of the data give the same hand-eye transform, within their uncertainty.

A reprojection error can be small because errors of the hand-eye transform, the camera and the
target pose compensate for each other. On real data this is the best check of the hand-eye transform
itself.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ...calibration import Calibration
from ...dataset import Dataset
from ...engine import step_names
from ...joint import MAX_ROTATION_HALF_WIDTH, MAX_TRANSLATION_HALF_WIDTH
from ..held_out import predictor_of

MAX_STANDARDISED_DIFFERENCE = 3.0
"""Threshold that the largest of six standardised differences exceeds in 2 % of data sets."""


class SplitHalfDifference(NamedTuple):
    """The difference between the hand-eye transforms of the even and the odd views.

    Attributes:
        rotation: angle between them, rad.
        translation: distance between them, m.
        standardised_difference: absolute difference of each of translation x, y, z and rotation
            x, y, z, over its stated standard deviation; None if the fits state none.
        fits: fits of the even and of the odd views.
    """

    rotation: float
    translation: float
    standardised_difference: Float[np.ndarray, "6"] | None
    fits: tuple[Any, Any]

    @property
    def description(self) -> str:
        """The difference in degrees and millimetres."""
        text = f"{np.rad2deg(self.rotation):.3f} deg and {1e3 * self.translation:.2f} mm apart"
        if self.standardised_difference is None:
            return text
        return f"{text}, {np.max(self.standardised_difference):.1f} stated std at most"

    @property
    def warnings(self) -> tuple[str, ...]:
        """The reasons to doubt the fit to all views, a sentence each; empty if there are none."""
        if self.translation > MAX_TRANSLATION_HALF_WIDTH or self.rotation > MAX_ROTATION_HALF_WIDTH:
            return (
                f"camera poses from even and odd views are {self.description}: too much for most "
                "uses; take more views, rotated about more axes",
            )
        if (
            self.standardised_difference is not None
            and np.max(self.standardised_difference) > MAX_STANDARDISED_DIFFERENCE
        ):
            return (
                f"camera poses from even and odd views are {self.description}: the stated "
                "uncertainty is too small",
            )
        return ()


def split_half_difference(data: Dataset, fitter: Callable[[Dataset], Any]) -> SplitHalfDifference:
    """Fit even and odd usable views separately, and compare their hand-eye transforms.

    Args:
        data: all views, in the order in which they were taken.
        fitter: function from a data set to a fit with a `.calibration`, or to a calibration. It is
            called with the other half's views masked.

    Raises:
        ValueError: fewer than six usable views, fits without a hand-eye transform, or an error of
            the fitter.
    """
    views = data.usable_views()
    if len(views) < 6:
        raise ValueError(f"two halves need at least 6 usable views, found {len(views)}")
    # Neighbouring views go to different halves, so that both cover the same workspace.
    even, odd = (fitter(data.mask_views(views[1 - k :: 2])) for k in (0, 1))
    even_mount, odd_mount = (_calibration(fit).camera_from_mount for fit in (even, odd))
    translation = np.asarray(even_mount.translation() - odd_mount.translation())
    # The fits' standard deviations are about the axes of `target_from_source`'s target frame, hence
    # R_even R_odd^-1.
    rotation = np.asarray((even_mount.rotation() @ odd_mount.rotation().inverse()).log())
    difference = np.concatenate([translation, rotation])
    stds = [_stated_std(fit) for fit in (even, odd)]
    standardised_difference = None
    if stds[0] is not None and stds[1] is not None:
        # Independent halves: the variance of the difference is the sum of the variances.
        combined_std = np.hypot(stds[0], stds[1])
        # Held parameters have no variance and are equal in both halves: their difference is 0.
        standardised_difference = np.abs(difference) / np.where(
            combined_std > 0.0, combined_std, np.inf
        )
    return SplitHalfDifference(
        float(np.linalg.norm(rotation)),
        float(np.linalg.norm(translation)),
        standardised_difference,
        (even, odd),
    )


def _calibration(fit: Any) -> Calibration:
    """Return a fit's calibration, or raise a `ValueError` if it has none."""
    predictor = predictor_of(fit)
    if not isinstance(predictor, Calibration):
        raise ValueError(f"expected fits with a Calibration, found {type(predictor).__name__}")
    return predictor


def _stated_std(fit: Any) -> Float[np.ndarray, "6"] | None:
    """Return the stated standard deviations of a fit's hand-eye transform: m, then rad; or None."""
    std = getattr(fit, "std", None)
    if std is None:
        return None
    names = step_names(_calibration(fit).transform_names[0])
    return np.array([std.get(name, 0.0) for name in names])
