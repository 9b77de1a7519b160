"""Judge whether the fit of a rig is plausible."""

from typing import TYPE_CHECKING

import numpy as np

from ..dataset import MINIMUM_RELIABLE_VIEWS, distinct_poses
from ..geometry import host_matrices
from ..robot_errors import RobotPrior
from .plausibility import MIN_SCALE_PROBABILITY
from .view_rejection import is_plausible

if TYPE_CHECKING:
    from .rig_fit import RigFit

MAX_LISTED = 4
"""Largest number of undetermined parameters that a warning lists."""


def rig_warnings(fit: "RigFit", prior: RobotPrior) -> tuple[str, ...]:
    """Return the reasons to doubt the fit of a rig, a sentence each, gravest first.

    Args:
        fit: the fit to judge.
        prior: prior on the sizes of the robot's errors.
    """
    warnings = [] if fit.result.converged else [fit.result.message]
    undetermined = [name for name in fit.parameter_names if not np.isfinite(fit.std[name])]
    if undetermined:
        more = len(undetermined) - MAX_LISTED
        listed = ", ".join(undetermined[:MAX_LISTED]) + (f" and {more} more" if more > 0 else "")
        warnings.append(
            f"the data do not determine {listed}: turn the robot about other axes, hold them by "
            "fixed=, or give priors"
        )
    for arm, built in fit.built_by_arm.items():
        named = f"{arm}: " if fit.bases else ""
        warnings += [f"{named}{text}" for text in _estimate_warnings(fit, arm, prior)]
        # Several pictures from one pose have no more information on the robot than one.
        poses = host_matrices(built.problem.command.base_from_tool)
        used = np.asarray(built.problem.per_view_free).any(axis=1)
        states = len(distinct_poses(poses[used]))
        if states < MINIMUM_RELIABLE_VIEWS:
            warnings.append(
                f"{named}{states} states of the robot are few: no figure is reliable with fewer "
                f"than {MINIMUM_RELIABLE_VIEWS}"
            )
    return tuple(warnings)


def _estimate_warnings(fit: "RigFit", arm: str, prior: RobotPrior) -> list[str]:
    """Return warnings about the estimated sizes of an arm's errors, and about the target's size."""
    estimate, noise = fit.noise_estimates.get(arm), fit.noises[arm]
    if estimate is None:
        return []
    warnings = []
    size = estimate.target_scale
    if size is not None and size.probability >= MIN_SCALE_PROBABILITY:
        warnings.append(
            f"the target may be {size.scale:.4f} +- {size.std:.4f} of its stated size (probability "
            f"{size.probability:.2f}): measure it"
        )
    if not is_plausible(noise, prior):
        warnings.append(
            f"the robot's poses err by {1e3 * noise.translation:.3g} mm and "
            f"{np.degrees(noise.rotation):.3g} degrees, which is much for a robot: mispaired "
            "views, a camera or a target that moved?"
        )
    if not estimate.converged:
        warnings.append("the estimate of the errors' sizes did not converge: take more views")
    return warnings
