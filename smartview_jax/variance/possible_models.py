"""Leave out impossible models, with a wildly wrong robot or target, before averaging.

Target, camera distance and motion can all shrink together without a change of the pictures. A model
that cancels the motion of the robot, or shrinks the target to a fraction, is degenerate: its
residuals are small because nothing is left to fit.
"""

import numpy as np
from jaxtyping import Float

from ..dataset import Dataset, chain_residuals
from ..engine import FittedChain
from ..geometry import host_exponentials, host_matrices

TARGET_SCALE_LIMITS = (0.2, 5.0)
"""Smallest and largest ratio of true to stated size of a target."""

MOTION_RATIO_LIMITS = (0.5, 2.0)
"""Smallest and largest ratio of actual to reported motion of a robot."""


def is_possible(chain: FittedChain, data: Dataset) -> bool:
    """Return whether a fitted chain has a plausible target and robot, and projects every view.

    Args:
        chain: the chain of every view.
        data: the data set that it was fitted to.
    """
    low, high = TARGET_SCALE_LIMITS
    if not low <= float(chain.calibration.target_scale) <= high:
        return False
    views = data.usable_views()
    low, high = MOTION_RATIO_LIMITS
    reported = host_matrices(data.base_from_tool)[views]
    if not low <= motion_ratio(reported, np.asarray(chain.field_corrections)[views]) <= high:
        return False
    residuals = np.asarray(chain_residuals(chain.calibration, data.observations))[views]
    visible = np.asarray(data.visible)[views]
    is_projected = visible & np.isfinite(residuals[..., 0]) & np.isfinite(residuals[..., 1])
    return bool((is_projected.any(axis=1) | ~visible.any(axis=1)).all())


def motion_ratio(
    reported: Float[np.ndarray, "views 4 4"], field_corrections: Float[np.ndarray, "views 6"]
) -> float:
    """Return the ratio of actual to reported motion; 1 for a robot that only rotated.

    Args:
        reported: reported poses of the tool.
        field_corrections: twists at the tool from the reported to the actual poses.
    """
    # The slope of actual over reported positions, by least squares.
    actual = reported @ host_exponentials(field_corrections)
    before, after = (poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0) for poses in (reported, actual))
    spread = np.sum(before**2)
    return float(np.sum(before * after) / spread) if spread > 0.0 else 1.0
