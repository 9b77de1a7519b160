"""Find the likeliest sizes of noises, of smooth errors and of a drift, and the evidence for them.

The search and Laplace's method use the slopes of the deviance (`walk_slopes`).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from .pose_variances import SMALLEST_PART, LogNormalPriors
from .tracker_drift import Walk, WalkFit, solved_walk
from .walk_slopes import deviance_slopes

MAX_LOG_FIELD = np.log(10.0)
"""Largest logarithm of the ratio of an arm's errors to a median arm's errors; beyond it, rounding
errors decide between its field and the mount."""

DEVIANCE_TOLERANCE = 1e-3
"""Change of the deviance that does not matter: a tenth of a percent of the likelihood."""

DIFFERENCE = 0.05
"""Step of the logarithms of standard deviations for differences of slopes."""


class LikeliestWalk(NamedTuple):
    """The likeliest standard deviations of noises, field and drift.

    Attributes:
        logarithms: of the standard deviations, in units.
        deviance: -2 log of their posterior density, but for a constant.
        fit: the best unknowns and drift.
    """

    logarithms: Float[np.ndarray, "kinds"]
    deviance: float
    fit: WalkFit


def likeliest_walk(
    walk: Walk, start: Float[np.ndarray, "kinds"], priors: LogNormalPriors
) -> LikeliestWalk:
    """Return the likeliest standard deviations.

    Args:
        walk: the model.
        start: logarithms of the standard deviations, in units, from which the search begins.
        priors: on all of them.

    Raises:
        LinAlgError: a chain so far from the poses that rounding errors decide.
    """
    deviance = _posterior_deviance(walk, priors)
    largest = np.full(len(start), -np.log(SMALLEST_PART))
    smallest, largest[len(walk.pairs.parts)] = -largest, MAX_LOG_FIELD
    optimum = minimize(
        deviance,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=list(zip(smallest, largest, strict=True)),
        options={"ftol": DEVIANCE_TOLERANCE / max(abs(deviance(start)[0]), 1.0)},
    )
    solved = solved_walk(walk, optimum.x)
    if solved.squares < 0.0:
        raise np.linalg.LinAlgError(
            "the tracker's drift is lost in rounding errors, because its poses are far from what "
            "the robot says: is its unit of length its own (scale=True), or are many pairs wrong?"
        )
    return LikeliestWalk(optimum.x, float(optimum.fun), solved.fit)


def walk_log_evidence(walk: Walk, likeliest: LikeliestWalk, priors: LogNormalPriors) -> float:
    """Return the logarithm of a model's evidence by Laplace's method, but for a constant.

    Args:
        walk, priors: as in `likeliest_walk`.
        likeliest: its result.
    """
    # log Z = -D / 2 - log det(D'' / 4 pi) / 2, in which the 2 pi of as many priors cancel.
    deviance, place = _posterior_deviance(walk, priors), likeliest.logarithms
    steps = DIFFERENCE * np.eye(len(place))
    slopes = [deviance(place + step)[1] - deviance(place - step)[1] for step in steps]
    curvature = 0.5 * np.array(slopes) / (2.0 * DIFFERENCE)
    curvature = 0.5 * (curvature + curvature.T)
    return -0.5 * (likeliest.deviance + float(np.linalg.slogdet(curvature)[1]))


def _posterior_deviance(
    walk: Walk, priors: LogNormalPriors
) -> Callable[[np.ndarray], tuple[float, np.ndarray]]:
    """Return -2 log of the posterior density and its slopes, as a function of the logarithms."""

    def deviance(logarithms: np.ndarray) -> tuple[float, np.ndarray]:
        solved = solved_walk(walk, logarithms)
        misses = (priors.powers @ logarithms - priors.means) / priors.stds
        prior = np.sum(misses**2) + 2.0 * np.log(priors.stds).sum()
        slopes = deviance_slopes(solved) + 2.0 * priors.powers.T @ (misses / priors.stds)
        return solved.deviance + float(prior), slopes

    return deviance
