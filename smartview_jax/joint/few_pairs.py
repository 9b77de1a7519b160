"""Tell which of a few pairs of poses are wrong, by evidence.

Three pairs give a solution, and a fourth of a few may agree with it by chance. So three
descriptions of the tracked poses are compared: most pairs agree and the others are anywhere, all
agree but have a larger noise, or all are anywhere. The density of the poses is averaged over the
unknown transforms and over the sizes of the noises, so that a solution pays for the numbers that it
takes from the poses.
"""

import math

import numpy as np

from ..dataset import UNIT_ROTATION, UNIT_TRANSLATION
from ..geometry import host_nearest_rotation, host_rotation_vectors
from .tracker_noise import TrackedChain, likeliest_noise

REACH = 1.0
"""Radius of the ball in which camera and target are about the hand and the base, m."""

UNIT_RANGE = 1e6
"""Largest over smallest unit of length of a tracker whose unit is unknown."""

LOG_ROTATIONS = math.log(8.0 * math.pi**2)
"""Logarithm of the volume of all rotations."""


def others_are_wrong(agreeing: TrackedChain, everything: TrackedChain) -> bool:
    """Return whether the pairs that do not agree with most others are wrong.

    Args:
        agreeing: the pairs that agree, at their solution.
        everything: all pairs, at the solution of all.
    """
    count, total = (int(chain.data.seen.sum()) for chain in (agreeing, everything))
    anywhere, unknowns = _log_density_anywhere(everything), _log_prior_of_unknowns(everything)
    # Every number of wrong pairs is equally probable beforehand.
    choice = math.log(math.comb(total, count))
    most = _log_density(agreeing) + unknowns + (total - count) * anywhere - choice
    return most > max(_log_density(everything) + unknowns, total * anywhere)


def _log_density(chain: TrackedChain) -> float:
    """Return the log density of tracked poses whose chain may be any, in the tracker's unit."""
    try:
        hypotheses = likeliest_noise(chain).hypotheses
    except np.linalg.LinAlgError:
        # Poses that are so far from every chain that rounding errors decide.
        return -math.inf
    densities = [hypothesis.log_density for hypothesis in hypotheses]
    axes = len({hypothesis.axis for hypothesis in hypotheses})
    metres_per_unit = float(chain.calibration.target_scale)
    by_unit = 3.0 * int(chain.data.seen.sum()) * math.log(metres_per_unit)
    return float(np.logaddexp.reduce(densities)) - math.log(axes) + by_unit


def _log_prior_of_unknowns(chain: TrackedChain) -> float:
    """Return the log density of both transforms, and of the unit if it is unknown, beforehand."""
    transform = -math.log(4.0 / 3.0 * math.pi * REACH**3) - LOG_ROTATIONS
    return 2.0 * transform - (math.log(math.log(UNIT_RANGE)) if chain.scale else 0.0)


def _log_density_anywhere(chain: TrackedChain) -> float:
    """Return the mean log density of a pose that is anywhere among all poses, m and rad.

    It is normal about their mean, or any rotation if they turn so much.
    """
    poses = chain.data.tracked_matrices[chain.data.seen]
    unit = UNIT_TRANSLATION / float(chain.calibration.target_scale)
    mean = np.eye(4)
    mean[:3, :3] = host_nearest_rotation(poses[:, :3, :3].mean(axis=0))
    turns = host_rotation_vectors(mean.T @ poses)
    places = poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)
    numbers = 3.0 * (len(poses) - 1)
    place, turn = (
        max(math.sqrt(float(np.sum(values**2)) / numbers), smallest)
        for values, smallest in ((places, unit), (turns, UNIT_ROTATION))
    )
    of_place, of_turn = (-1.5 * math.log(2.0 * math.pi * math.e * std**2) for std in (place, turn))
    return of_place + max(of_turn, -LOG_ROTATIONS)
