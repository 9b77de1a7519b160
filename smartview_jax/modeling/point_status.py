"""Describe in words how the estimation of a point or a line ended."""

from enum import IntEnum

import numpy as np
from jaxtyping import Int

MAX_RELATIVE_STD = 0.25
"""Largest standard deviation of a point's distance, over the distance, of a returned point.

Above it its rays are parallel within their errors, and no Gaussian describes its position."""


class PointStatus(IntEnum):
    """The outcome of the estimation of one point or line."""

    OK = 0
    TOO_FEW_VIEWS = 1
    DEGENERATE_BASELINE = 2
    BEHIND_CAMERA = 3
    NOT_CONVERGED = 4
    EPIPOLAR_PLANE = 5

    @property
    def message(self) -> str:
        """A sentence for people that says what is wrong."""
        return _MESSAGES[self]


_MESSAGES = {
    PointStatus.OK: "it was estimated",
    PointStatus.TOO_FEW_VIEWS: "fewer than two views see it where their lens is valid",
    PointStatus.DEGENERATE_BASELINE: "its rays are parallel within their errors, so that its "
    "distance is undetermined: views from further apart are needed",
    PointStatus.BEHIND_CAMERA: "its rays meet behind a camera that sees it, or outside its "
    "lens: the correspondence or a pose is wrong",
    PointStatus.NOT_CONVERGED: "the least-squares estimate did not converge",
    PointStatus.EPIPOLAR_PLANE: "it lies in the epipolar plane of its views within its errors: "
    "any line of that plane explains them, and a view from outside it is needed",
}


def failure_messages(status: Int[np.ndarray, "features"]) -> dict[int, str]:
    """Return the reason, in words, for every point or line that failed, by its index."""
    failed = np.flatnonzero(status != PointStatus.OK)
    return {int(k): PointStatus(status[k]).message for k in failed}
