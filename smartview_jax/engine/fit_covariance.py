"""The covariance of a fit's parameters, from the normal equations at its solution."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .abstract_problem import AbstractBuiltProblem
from .covariance import (
    ReducedEquations,
    ScaledJacobian,
    covariance,
    per_view_std,
    reduced_equations,
)
from .schur import BlockArrow


class FitCovariance(NamedTuple):
    """The covariance of the parameters that all views share, and what the views' own follow from.

    Attributes:
        reduced: the normal equations of the shared parameters alone.
        jacobian: their Jacobian, scaled to unit columns, whose singular values have no units.
        variance_factor: factor by which the assumed variances are wrong.
        shared: covariance of the shared parameters.
        std: their standard deviations, infinite where nothing determines them.
        degrees_of_freedom: degrees of freedom of their intervals.
    """

    reduced: ReducedEquations
    jacobian: ScaledJacobian
    variance_factor: float
    shared: Float[np.ndarray, "parameters parameters"]
    std: Float[np.ndarray, "parameters"]
    degrees_of_freedom: Float[np.ndarray, "parameters"]

    @classmethod
    def of(cls, matrix: BlockArrow, variance_factor: float = 1.0) -> "FitCovariance":
        """Return the covariance for known noise: f R^-1, with R the reduced normal equations.

        Args:
            matrix: the normal equations at the solution.
            variance_factor: the factor f by which the assumed variances are wrong; one if they are
                known or estimated.
        """
        reduced = reduced_equations(matrix)
        norms = np.sqrt(np.diagonal(np.asarray(matrix.shared)))
        jacobian = ScaledJacobian(reduced.schur_complement, norms)
        shared, std = covariance(jacobian, variance_factor)
        freedom = np.full(len(std), np.inf)
        return cls(reduced, jacobian, variance_factor, shared, std, freedom)

    def with_added(
        self,
        added: Float[np.ndarray, "parameters parameters"],
        degrees_of_freedom: Float[np.ndarray, "parameters"],
    ) -> "FitCovariance":
        """Return the covariance with what the estimation of the noise adds, and finite freedom."""
        return self._replace(
            shared=self.shared + added,
            std=np.sqrt(self.std**2 + np.diagonal(added)),
            degrees_of_freedom=degrees_of_freedom,
        )

    def std_by_name(self, built: AbstractBuiltProblem) -> dict[str, float]:
        """Return the standard deviations of all parameters, single views' own among them."""
        # diag(f C_v^-1 + G_v P G_v^T), with G_v = C_v^-1 B_v and P the shared covariance.
        problem = built.problem
        of_views = per_view_std(
            self.reduced, self.shared, self.variance_factor, problem.host_correction_roots
        )
        of_views = of_views[np.asarray(problem.per_view_free)]
        names = (*built.shared_names, *built.per_view_names)
        return dict(zip(names, map(float, (*self.std, *of_views)), strict=True))

    def freedom_by_name(self, built: AbstractBuiltProblem) -> dict[str, float]:
        """Return the degrees of freedom of the shared parameters."""
        return dict(zip(built.shared_names, map(float, self.degrees_of_freedom), strict=True))
