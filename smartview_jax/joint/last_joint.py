"""Compute the uncertainty of the mount for known errors of the last joint.

An error of the last joint's zero rotates everything after it, as the hand-eye transform does: no
view can separate the two. Only their combination moves the camera.
"""

import numpy as np

from ..engine import ROBOT_ERROR
from ..robot_errors import nominal_arm
from .joint_fit import JointFit, half_width


def half_widths_with_last_joint_held(fit: JointFit) -> dict[str, float]:
    """Return the half widths of the mount's 95 % intervals if the last joint's errors were known.

    Empty without free errors of an arm's last joint.
    """
    arm = nominal_arm(fit.calibration.field)
    if arm is None:
        return {}
    names, last = fit.parameter_names, str(arm.joint_count)
    mount = f"{fit.calibration.transform_names[0]}."
    known = [
        k
        for k, name in enumerate(names)
        if name.startswith(f"{ROBOT_ERROR}.") and name.split(".")[-1] == last
    ]
    wanted = [k for k, name in enumerate(names) if name.startswith(mount)]
    if not known or not wanted:
        return {}
    covariance = np.asarray(fit.covariance)
    # Cov(a | b) = P_aa - P_ab P_bb^-1 P_ba
    across = covariance[np.ix_(wanted, known)]
    explained = across @ np.linalg.pinv(covariance[np.ix_(known, known)], hermitian=True) @ across.T
    conditional = np.diagonal(covariance[np.ix_(wanted, wanted)] - explained).clip(0.0)
    freedom = fit.degrees_of_freedom
    return {
        names[k]: half_width(float(np.sqrt(variance)), freedom[names[k]])
        for k, variance in zip(wanted, conditional, strict=True)
    }
