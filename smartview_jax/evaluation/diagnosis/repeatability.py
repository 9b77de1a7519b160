"""Test whether two halves of the data give the same hand-eye transform, within their uncertainty.

A reprojection error can be small because a wrong mount, a wrong camera and a wrong target pose
compensate for each other. No other check on real data says more about the mount itself.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ...calibration import Calibration
from ...dataset import Dataset
from ...joint import COARSE_ROTATION, COARSE_TRANSLATION
from ..held_out import predictor_of

DISAGREEING = 3.0
"""The largest of six standardised differences that halves exceed in one data set out of fifty."""


class Repeatability(NamedTuple):
    """The difference between the hand-eye transforms of the even and the odd views.

    Attributes:
        rotation: angle between them, rad.
        translation: distance between them, m.
        in_std: difference of each of translation x, y, z and rotation x, y, z, over its stated
            standard deviation; None where the fits state none.
        fits: fits of the even and of the odd views.
    """

    rotation: float
    translation: float
    in_std: Float[np.ndarray, "6"] | None
    fits: tuple[Any, Any]

    @property
    def words(self) -> str:
        """The difference in degrees and millimetres."""
        text = f"{np.rad2deg(self.rotation):.3f} deg and {1e3 * self.translation:.2f} mm apart"
        if self.in_std is None:
            return text
        return f"{text}, {np.max(self.in_std):.1f} stated std at most"

    @property
    def warnings(self) -> tuple[str, ...]:
        """The doubts that the halves raise about the fit to all views, a sentence each."""
        if self.translation > COARSE_TRANSLATION or self.rotation > COARSE_ROTATION:
            return (
                f"even and odd views put the camera {self.words}: more than most uses bear; take "
                f"more views, turned about more axes",
            )
        if self.in_std is not None and np.max(self.in_std) > DISAGREEING:
            return (
                f"even and odd views put the camera {self.words}: it is known less well than "
                f"stated",
            )
        return ()


def repeatability(data: Dataset, fitter: Callable[[Dataset], Any]) -> Repeatability:
    """Fit even and odd usable views separately, and compare where they put the camera.

    Args:
        data: all views, in the order in which they were taken: neighbours are put in different
            halves.
        fitter: function from a data set to a fit with a `.calibration`, or to a calibration. The
            other half's views come to it with nothing visible.

    Raises:
        ValueError: fewer than six usable views, fits without a hand-eye transform, or as the fitter
            does.
    """
    views = data.usable_views()
    if len(views) < 6:
        raise ValueError(f"two halves need at least 6 usable views, found {len(views)}")
    # Neighbouring views go to different halves, so that both cover the same workspace.
    even, odd = (fitter(data.without(views[1 - k :: 2])) for k in (0, 1))
    one, other = (_calibration(fit).camera_from_mount for fit in (even, odd))
    apart = np.asarray(one.translation() - other.translation())
    # The fits' standard deviations are about the axes of the target frame, hence R_1 R_2^-1.
    turn = np.asarray((one.rotation() @ other.rotation().inverse()).log())
    difference = np.concatenate([apart, turn])
    stds = [_stated(fit) for fit in (even, odd)]
    in_std = None
    if stds[0] is not None and stds[1] is not None:
        # Independent halves: the variance of the difference is the sum of the variances. Held
        # parameters have none and are the same in both.
        both = np.hypot(stds[0], stds[1])
        # What the fits held is the same in both, and known.
        in_std = np.abs(difference) / np.where(both > 0.0, both, np.inf)
    return Repeatability(
        float(np.linalg.norm(turn)), float(np.linalg.norm(apart)), in_std, (even, odd)
    )


def _calibration(fit: Any) -> Calibration:
    """Return a fit's calibration, or raise a `ValueError` if it has none."""
    found = predictor_of(fit)
    if not isinstance(found, Calibration):
        raise ValueError(f"expected fits with a Calibration, found {type(found).__name__}")
    return found


def _stated(fit: Any) -> Float[np.ndarray, "6"] | None:
    """Return the stated standard deviations of a fit's hand-eye transform: m, then rad; or None."""
    std = getattr(fit, "std", None)
    if std is None:
        return None
    name = _calibration(fit).transform_names[0]
    parts = [f"{part}.{axis}" for part in ("translation", "rotation") for axis in "xyz"]
    return np.array([std.get(f"{name}.{part}", 0.0) for part in parts])
