"""Free what an arm's own motion leaves open, where the fit of several arms determines it.

An arm that turns about one axis does not tell where along this axis its camera is on the hand: the
fit of the arm alone holds it. If the place of the arm's base is known, another arm that sees the
same target tells it.
"""

from collections.abc import Collection, Sequence

import numpy as np
from jaxtyping import Float

from ..engine import BuiltRig, Step, StructuredLM, host_step, solve
from ..runtime.array_namespace import to_device
from ..runtime.modules import with_fields
from ..variance import RigNoiseEstimate
from .arm_fit import SolvedArm


def with_told_by_others(arm: SolvedArm, held: Collection[str]) -> SolvedArm:
    """Return the fit of one arm with free parameters that its own motion leaves open.

    They stay where they started, which is as good as anywhere for the arm alone.

    Args:
        arm: the fit of one arm, or of a pair of arms.
        held: names of the parameters to hold because all arms together leave them open.
    """
    told = [name for name in arm.undetermined.held if name not in held]
    if not told:
        return arm
    built, old_rows = _with_free(arm.built, told)
    shared = np.zeros(len(built.shared_names))
    shared[old_rows] = np.asarray(arm.solution.z.shared)
    start = host_step(shared, np.asarray(arm.solution.z.per_view))
    # With an infinite tolerance the solver ends where it begins.
    solution, equations = solve(built.problem, StructuredLM(atol=np.inf), start=start)
    estimate = arm.estimate
    if estimate is not None:
        estimate = _padded(estimate, built, start, old_rows)
    return arm._replace(built=built, estimate=estimate, solution=solution, equations=equations)


def _with_free(built: BuiltRig, names: Collection[str]) -> tuple[BuiltRig, list[int]]:
    """Return a problem with more free parameters, and the rows among all free ones of the old."""
    every = built.parameter_names
    free = tuple(name for name in every if name in built.shared_names or name in names)
    index = np.array([every.index(name) for name in free])
    problem, scale = built.problem, built.problem.scale
    released = with_fields(
        problem,
        free=to_device(index),
        scale=Step(to_device(np.ones(len(free))), scale.per_view),
    )
    rows = [free.index(name) for name in built.shared_names]
    return with_fields(built, problem=released, shared_names=free), rows


def _padded(
    estimate: RigNoiseEstimate, built: BuiltRig, start: Step, rows: Sequence[int]
) -> RigNoiseEstimate:
    """Return an estimate of the noise for a problem with more free parameters.

    Args:
        estimate: the estimate.
        built: the problem.
        start: its solution.
        rows: rows of the estimate's parameters among the problem's.
    """
    size, correction = len(built.shared_names), estimate.small_sample_correction
    places = np.ix_(rows, rows)

    def padded(matrix: Float[np.ndarray, "old old"]) -> Float[np.ndarray, "new new"]:
        """Return a matrix with zeros for the added parameters."""
        result = np.zeros((size, size))
        result[places] = matrix
        return result

    freedom = np.full(size, np.inf)
    freedom[rows] = correction.degrees_of_freedom
    derivatives = [padded(each) for each in correction.covariance_derivatives]
    return estimate._replace(
        built=built,
        step=start,
        small_sample_correction=correction._replace(
            added_covariance=padded(correction.added_covariance),
            degrees_of_freedom=freedom,
            covariance_derivatives=np.array(derivatives).reshape(-1, size, size),
        ),
        between_models_covariance=padded(estimate.between_models_covariance),
    )
