"""Find out whether a tracker that seems to drift has a unit of length of its own instead.

The positions of a single moving camera have an unknown unit. Measured against a robot in metres
they go astray more and more, as with a tracker that drifts, and a drift that is estimated
absorbs most of it: robot and tracker then seem to agree, with a camera far from its place. So both
models are compared by their evidence, with the prior of a target that is not of its stated size.
"""

import numpy as np

from ..calibration import Calibration
from ..dataset import PoseDataset
from ..robot_errors import RobotPrior
from .drifting_tracker import likeliest_drift
from .tracker_noise import TrackerPrior, likeliest_noise


def has_own_unit(
    data: PoseDataset,
    given: Calibration,
    scaled: Calibration,
    robot_prior: RobotPrior,
    tracker_prior: TrackerPrior,
) -> bool:
    """Return whether the tracker's unit is rather its own than the metre.

    Args:
        data: the pairs that agree with both calibrations, in the order in which they were measured.
        given: near the solution in metres.
        scaled: near the solution with a unit of the tracker's own.
        robot_prior, tracker_prior: as in `fit_poses`.
    """
    probability = robot_prior.wrong_target_probability
    if probability == 0.0:
        return False
    noises = robot_prior, tracker_prior
    drifts, in_metres = _drift_and_evidence(data, given, False, *noises)
    drifts_in_own_unit, in_own_unit = _drift_and_evidence(data, scaled, True, *noises)
    # Of a steady tracker the joint fit asks whether the target has its stated size.
    if not (drifts or drifts_in_own_unit):
        return False
    # The likelihood is of positions in the tracker's unit.
    size = float(np.log(scaled.target_scale))
    in_own_unit += 3.0 * np.count_nonzero(data.seen) * size
    # Its logarithm is normal.
    std = robot_prior.wrong_target_scale_std
    prior = -0.5 * (size / std) ** 2 - np.log(std * np.sqrt(2.0 * np.pi))
    odds = np.log(probability / (1.0 - probability))
    return bool(in_own_unit + prior + odds > in_metres)


def _drift_and_evidence(
    data: PoseDataset,
    start: Calibration,
    scale: bool,
    robot_prior: RobotPrior,
    tracker_prior: TrackerPrior,
) -> tuple[bool, float]:
    """Return whether the tracker drifts, and the logarithm of the evidence of the likelier answer.

    Args:
        data, robot_prior, tracker_prior: as in `has_own_unit`.
        start: near the solution.
        scale: whether the tracker's unit is unknown.
    """
    try:
        noise = likeliest_noise(data, start, scale, robot_prior, tracker_prior)
        drift, evidence = likeliest_drift(data, noise, start, scale, robot_prior, tracker_prior)
    except np.linalg.LinAlgError:
        # In a wrong unit the drift may be so large that the chain is lost in rounding errors.
        return False, -np.inf
    return drift is not None, evidence
