"""The covariance of a fit's parameters, from the normal equations at its solution."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .abstract_problem import AbstractBuiltProblem
from .covariance import (
    ReducedEquations,
    ScaledJacobian,
    covariance,
    covariance_by_names,
    per_view_std,
    reduced_equations,
)
from .pixel_aspect import aspect_of, is_alpha_v
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
        fitted_by_named: derivative of the parameters that were fitted by these, if they differ.
        fitted_variances: variances of the parameters that were fitted, if they differ.
    """

    reduced: ReducedEquations
    jacobian: ScaledJacobian
    variance_factor: float
    shared: Float[np.ndarray, "parameters parameters"]
    std: Float[np.ndarray, "parameters"]
    degrees_of_freedom: Float[np.ndarray, "parameters"]
    fitted_by_named: Float[np.ndarray, "parameters parameters"] | None = None
    fitted_variances: Float[np.ndarray, "parameters"] | None = None

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

    def by_names(self, named_by_fitted: Float[np.ndarray, "n n"] | None) -> "FitCovariance":
        """Return the covariance of the parameters as they are named; the Jacobian stays.

        Args:
            named_by_fitted: as in `covariance_by_names`.
        """
        if named_by_fitted is None:
            return self
        shared, std = covariance_by_names(self.shared, self.std, named_by_fitted)
        fitted_by_named = np.linalg.inv(named_by_fitted)
        reduced = self.reduced._replace(
            schur_complement=fitted_by_named.T @ self.reduced.schur_complement @ fitted_by_named,
            gain=self.reduced.gain @ fitted_by_named,
        )
        return self._replace(
            reduced=reduced,
            shared=shared,
            std=std,
            fitted_by_named=fitted_by_named,
            fitted_variances=self.std**2,
        )

    def with_added(
        self,
        added: Float[np.ndarray, "parameters parameters"],
        degrees_of_freedom: Float[np.ndarray, "parameters"],
    ) -> "FitCovariance":
        """Return the covariance with what the estimation of the noise adds, and finite freedom."""
        by_named, fitted_variances = self.fitted_by_named, self.fitted_variances
        if by_named is not None and fitted_variances is not None:
            # Rounding may make what is added to a ratio that is known slightly negative.
            of_fitted = np.diagonal(by_named @ added @ by_named.T).clip(0.0)
            fitted_variances = fitted_variances + of_fitted
        return self._replace(
            shared=self.shared + added,
            std=np.sqrt(self.std**2 + np.diagonal(added)),
            degrees_of_freedom=degrees_of_freedom,
            fitted_variances=fitted_variances,
        )

    def std_by_name(self, built: AbstractBuiltProblem) -> dict[str, float]:
        """Return the standard deviations of all parameters, single views' own among them.

        Ratios of focal lengths that were fitted have one, too.
        """
        # diag(f C_v^-1 + G_v P G_v^T), with G_v = C_v^-1 B_v and P the shared covariance.
        problem = built.problem
        of_views = per_view_std(
            self.reduced, self.shared, self.variance_factor, problem.host_correction_roots
        )
        of_views = of_views[np.asarray(problem.per_view_free)]
        names = (*built.shared_names, *built.per_view_names)
        by_name = dict(zip(names, map(float, (*self.std, *of_views)), strict=True))
        variances = self.fitted_variances
        if variances is None:
            return by_name
        stds = np.sqrt(variances)
        return by_name | {name: float(stds[k]) for name, k in self._aspects(built).items()}

    def freedom_by_name(self, built: AbstractBuiltProblem) -> dict[str, float]:
        """Return the degrees of freedom of the shared parameters.

        Ratios of focal lengths that were fitted have alpha_v's.
        """
        names, freedom = built.shared_names, list(map(float, self.degrees_of_freedom))
        of_aspects = {name: freedom[k] for name, k in self._aspects(built).items()}
        return dict(zip(names, freedom, strict=True)) | of_aspects

    def _aspects(self, built: AbstractBuiltProblem) -> dict[str, int]:
        """Return the place of each ratio of focal lengths that was fitted, by its name."""
        matrix = self.fitted_by_named
        if matrix is None:
            return {}
        return {
            aspect_of(name): k
            for k, name in enumerate(built.shared_names)
            if is_alpha_v(name) and matrix[k, k] != 1.0
        }
