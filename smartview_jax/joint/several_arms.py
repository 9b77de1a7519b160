"""Fit several arms that see targets in common together, from the fit of each arm alone.

The sizes of an arm's errors are told by its own states, and a state that contradicts the others by
the states of its own arm. Arms have only the targets in common.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Float
from scipy.special import chdtrc

from ..dataset import Rig, arms_of
from ..engine import (
    BuiltArms,
    NormalEquations,
    Prior,
    Solution,
    build_arms,
    host_retract_transform,
    reduced_equations,
    solve_rig_on,
)
from ..variance import SmallSampleCorrection, joined_corrections
from .arm_fit import SolvedArm

DISAGREEMENT_PROBABILITY = 1e-6
"""Probability of a disagreement of arms by chance below which they are said to disagree.

As far below the usual level as for a view that is left out, for the same reason: the errors of real
robots have longer tails than the normal distribution.
"""


class JoinedArms(NamedTuple):
    """The problem of several arms, and its solution.

    Attributes:
        built: the problem.
        solution: the solution.
        equations: the normal equations at the solution.
        disagreement: what the arms say differently about their common targets; empty if nothing.
        robots: names of the arms; the base of the first is the reference.
    """

    built: BuiltArms
    solution: Solution
    equations: NormalEquations
    disagreement: tuple[str, ...]
    robots: tuple[str, ...]

    @property
    def bases(self) -> dict[str, SE3]:
        """The transform from each arm's base to the base of the first."""
        # The base of the first arm has indices after the last parameter.
        shared = np.append(_all_parameters(self.built, self.solution), np.zeros(6))
        result = {}
        for name, arm in zip(self.built.arms, self.built.problem.arms, strict=True):
            first, *others = arms_of(name)
            step = shared[np.asarray(arm.base_index)]
            result[first] = host_retract_transform(arm.first_base_from_base, step)
            # The linked pose of a pair is its other base; the linked poses of one arm are targets.
            for other, rows in zip(others, np.asarray(arm.linked_poses), strict=False):
                start = SE3(arm.first_base_from_linked.wxyz_xyz[0])
                step = shared[np.asarray(arm.parameter_index)[rows]]
                result[other] = host_retract_transform(start, step)
        return {arm: result[arm] for arm in self.robots}


def join_arms(
    rig: Rig,
    arms: Mapping[str, SolvedArm],
    priors: Mapping[str, Prior] | None = None,
    devices: Sequence[Any] | None = None,
) -> JoinedArms:
    """Fit several arms together.

    Args:
        rig: data sets of all arms.
        arms: fit of each arm and pair of arms alone.
        priors: as for `build_arms`.
        devices: devices over which the views are distributed; None for the default one.
    """
    solved = {name: (arm.built, arm.solution.z) for name, arm in arms.items()}
    built, start = build_arms(rig, solved, priors)
    solution, equations = solve_rig_on(devices, built.problem, start)
    disagreement = _disagreement(built, solution, arms)
    return JoinedArms(built, solution, equations, disagreement, rig.robot_names)


def _disagreement(
    built: BuiltArms, solution: Solution, arms: Mapping[str, SolvedArm]
) -> tuple[str, ...]:
    """Return a sentence if the arms contradict each other about their common targets."""
    # Twice the cost that one fit has more than a fit for each arm is chi-square, with as many
    # degrees of freedom as it has fewer parameters.
    freedom = sum(len(arm.built.shared_names) for arm in arms.values()) - len(built.shared_names)
    excess = solution.costs[-1] - sum(arm.solution.costs[-1] for arm in arms.values())
    if freedom <= 0 or not chdtrc(freedom, 2.0 * excess) < DISAGREEMENT_PROBABILITY:
        return ()
    return (
        f"the arms {', '.join(arms)} contradict each other about the targets that several of them "
        f"see (chi-square {2.0 * excess:.0f} for {freedom} degrees of freedom): was a target or a "
        "base moved between their views?",
    )


def own_jacobians(built: BuiltArms, solution: Solution) -> dict[str, Float[np.ndarray, "own free"]]:
    """Return the derivative of each arm's free parameters by the free parameters of all."""
    shared, free = _all_parameters(built, solution), np.asarray(built.problem.free)
    return {
        name: arm.host_jacobian(shared)[np.ix_(np.asarray(arm_names.problem.free), free)]
        for (name, arm_names), arm in zip(built.arms.items(), built.problem.arms, strict=True)
    }


def added_by_estimation(
    joined: JoinedArms,
    arms: Mapping[str, SolvedArm],
    covariance: Float[np.ndarray, "free free"],
) -> tuple[Float[np.ndarray, "free free"], SmallSampleCorrection] | None:
    """Return what estimated noise adds to the covariance, and the correction that it is due to.

    None if the noise was given.

    Args:
        joined: the fit of all arms.
        arms: the fit of each arm alone.
        covariance: covariance of the free parameters for known noise.
    """
    jacobians = own_jacobians(joined.built, joined.solution)
    corrections, between = [], np.zeros_like(covariance)
    for name, arm in arms.items():
        if arm.estimate is None:
            return None
        # The common parameters follow an arm's own by C J^T A, with A the arm's information.
        information = reduced_equations(arm.equations.matrix).schur_complement
        effect = covariance @ jacobians[name].T @ information
        corrections.append((arm.estimate.small_sample_correction, effect))
        between += effect @ arm.estimate.between_models_covariance @ effect.T
    correction = joined_corrections(corrections, np.diagonal(covariance))
    return correction.added_covariance + between, correction


def _all_parameters(built: BuiltArms, solution: Solution) -> Float[np.ndarray, "shared"]:
    """Return the step of all shared parameters at the solution, zero for held ones."""
    step = np.zeros(built.problem.parameter_count)
    step[np.asarray(built.problem.free)] = np.asarray(solution.z.shared)
    return step
