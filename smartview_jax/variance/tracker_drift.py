"""Estimate how a tracker drifts: errors of its poses that grow from one pose to the next.

Visual odometry adds up motions between pictures, and with them their errors. Its reference frame
takes a random walk: with the twist d_k of the world at view k and the error r_k that is new in it,

    r_k = Ad_k (d_k - d_(k-1)) ~ N(0, diag(s^2)),    Ad_k of the world's frame to the camera's.

The d_k are random effects. Their information is block tridiagonal, so that the restricted
likelihood (see `pose_variances`) takes a banded Cholesky factorisation and a time proportional to
the number of views.

References: Henderson, Best linear unbiased estimation and prediction under a selection model, 1975
(estimates of fixed and random effects together); Rue and Held, Gaussian Markov random fields,
2005, section 2.4 (banded factorisation).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cho_solve_banded, cholesky_banded

from ..dataset import UNIT_ROTATION, UNIT_TRANSLATION
from .pose_variances import LinearPairs

UNIT_SCALE = 1e-2
"""Unit of the change of a drifting scale from one view to the next (relative)."""

ROUNDING = 1e-13
"""Smallest eigenvalue of a normal matrix with a diagonal of ones that is no rounding error."""

MIN_TOLD = 1e-6
"""Smallest change by a step of the unknowns that tells them, as a fraction of the largest."""


class Walk(NamedTuple):
    """Pairs whose tracker may drift.

    Attributes:
        pairs: all pairs in the order in which they were taken.
        used: mask of the pairs that are fitted; the drift goes on through the others.
        by_drift: change of the predictions by the drift: the twist of the world in the holder's
            frame, and the logarithm of the scale if that may drift.
        to_step: what takes a change of the drift to the error that is new in a view.
        by_field: change of the predictions by the coefficients of a robot error field.
        field_stds: their prior standard deviations for an arm of median accuracy.
        drifts: whether the tracker drifts in this model.
        told: basis of the steps of the unknowns that change anything.
    """

    pairs: LinearPairs
    used: Bool[np.ndarray, "views"]
    by_drift: Float[np.ndarray, "views 6 drifts"]
    to_step: Float[np.ndarray, "views drifts drifts"]
    by_field: Float[np.ndarray, "views 6 coefficients"]
    field_stds: Float[np.ndarray, "coefficients"]
    drifts: bool
    told: Float[np.ndarray, "unknowns told"]

    @classmethod
    def of(
        cls,
        pairs: LinearPairs,
        used: Bool[np.ndarray, "views"],
        by_field: Float[np.ndarray, "views 6 coefficients"],
        field_stds: Float[np.ndarray, "coefficients"],
        drifts: bool,
    ) -> "Walk":
        """Return the model of pairs; unknowns after both transforms may drift as well."""
        by_twist, by_holder = pairs.by_unknowns[:, :, :6], pairs.by_unknowns[:, :, 6:12]
        by_drift = pairs.by_unknowns[:, :, 6:]
        count = by_drift.shape[2]
        to_step = np.tile(np.eye(count), (len(used), 1, 1))
        to_step[:, :6, :6] = np.linalg.solve(by_twist, by_holder)
        told = _told(pairs.by_unknowns[used])
        return cls(pairs, used, by_drift, to_step, by_field, field_stds, drifts, told)

    @property
    def drift_units(self) -> tuple[tuple[float, int], ...]:
        """Unit and number of components of each kind of drift."""
        scale = self.by_drift.shape[2] - 6
        return (UNIT_TRANSLATION, 3), (UNIT_ROTATION, 3), *([(UNIT_SCALE, 1)] if scale else [])

    def drift_stds(self, logarithms: Float[np.ndarray, "kinds"]) -> Float[np.ndarray, "drifts"]:
        """Return the standard deviation of each component of the error that is new in a view."""
        sizes = np.exp(logarithms[len(self.pairs.parts) + 1 :])
        units = zip(sizes, self.drift_units, strict=True)
        return np.concatenate([np.full(count, size * unit) for size, (unit, count) in units])


class WalkFit(NamedTuple):
    """The best unknowns and drift for some standard deviations.

    Attributes:
        deviance: -2 log of the restricted likelihood, but for a constant.
        unknowns: step of the unknowns of the pairs, then of the field.
        covariance: of these; zero in directions that nothing tells.
        drift: the drift in every view, from the first on.
    """

    deviance: float
    unknowns: Float[np.ndarray, "unknowns"]
    covariance: Float[np.ndarray, "unknowns unknowns"]
    drift: Float[np.ndarray, "views drifts"]


def serial_correlation(pairs: LinearPairs, variances: Float[np.ndarray, "parts"]) -> float:
    """Return the correlation of successive errors, in its standard deviations if there is none."""
    covariance = np.einsum("k,kvij->vij", variances, pairs.parts)
    residuals = pairs.errors - pairs.by_unknowns @ pairs.solved(variances)
    white = np.linalg.solve(np.linalg.cholesky(covariance), residuals[..., None])[..., 0]
    products = white[1:] * white[:-1]
    return float(products.sum() / np.sqrt(max(np.sum(products**2), np.finfo(float).tiny)))


class SolvedWalk(NamedTuple):
    """The normal equations of unknowns and drift for some standard deviations, solved.

    The columns are the steps of the told unknowns and the field's coefficients in units of their
    standard deviations; the last one has the errors.

    Attributes:
        walk, logarithms: the model and its standard deviations.
        deviance: -2 log of the restricted likelihood, but for a constant.
        squares: weighted sum of squares that is left over; negative only where it is lost in
            rounding errors.
        information: inverse covariance of the errors in each used view.
        numbers: the columns in the used views.
        eliminated: drift that would follow each column, in all views.
        inverse: covariance of the columns' coefficients.
        coefficients: the best ones.
        factor: Cholesky factor of the information on the drift from the second view on, as a lower
            band; None without a drift.
    """

    walk: Walk
    logarithms: Float[np.ndarray, "kinds"]
    deviance: float
    squares: float
    information: Float[np.ndarray, "used 6 6"]
    numbers: Float[np.ndarray, "used 6 columns"]
    eliminated: Float[np.ndarray, "views drifts columns"]
    inverse: Float[np.ndarray, "coefficients coefficients"]
    coefficients: Float[np.ndarray, "coefficients"]
    factor: Float[np.ndarray, "band drift"] | None

    @property
    def drift(self) -> Float[np.ndarray, "views drifts"]:
        """The best drift in every view, from the first on."""
        return self.eliminated[:, :, -1] - self.eliminated[:, :, :-1] @ self.coefficients

    @property
    def fit(self) -> WalkFit:
        """The best unknowns and drift."""
        walk = self.walk
        count, told = walk.told.shape
        field_stds = np.exp(self.logarithms[len(walk.pairs.parts)]) * walk.field_stds
        basis = np.zeros((count + len(field_stds), len(self.coefficients)))
        basis[:count, :told], basis[count:, told:] = walk.told, np.diag(field_stds)
        return WalkFit(
            self.deviance, basis @ self.coefficients, basis @ self.inverse @ basis.T, self.drift
        )


def solved_walk(walk: Walk, logarithms: Float[np.ndarray, "kinds"]) -> SolvedWalk:
    """Return the best unknowns and drift for the standard deviations with these logarithms."""
    pairs, used, parts = walk.pairs, walk.used, len(walk.pairs.parts)
    covariance = np.einsum("k,kvij->vij", np.exp(2.0 * logarithms[:parts]), pairs.parts[:, used])
    information = np.linalg.inv(covariance)
    # The field's coefficients are in units of their standard deviations.
    field_stds = np.exp(logarithms[parts]) * walk.field_stds
    told = walk.told.shape[1]
    prior = np.diag(np.pad(np.ones(len(field_stds)), (told, 0)))
    # With the errors as the last column, all sums over the views are taken together.
    numbers = np.concatenate(
        [pairs.by_unknowns @ walk.told, walk.by_field * field_stds, pairs.errors[:, :, None]],
        axis=2,
    )[used]
    weighted = information @ numbers
    normal = _sum_of_products(numbers, weighted)
    deviance = float(np.linalg.slogdet(covariance)[1].sum())
    eliminated = np.zeros((len(used), walk.by_drift.shape[2], numbers.shape[2]))
    factor = None
    if walk.drifts:
        right, eliminated, factor, log_determinant = _eliminated_drift(
            walk, walk.drift_stds(logarithms), information, weighted
        )
        normal = normal - _sum_of_products(right, eliminated)
        deviance += log_determinant
    inverse, log_determinant = _inverse(normal[:-1, :-1] + prior)
    coefficients = inverse @ normal[:-1, -1]
    squares = float(normal[-1, -1] - normal[:-1, -1] @ coefficients)
    deviance += log_determinant + squares
    return SolvedWalk(
        walk,
        logarithms,
        deviance,
        squares,
        information,
        numbers,
        eliminated,
        inverse,
        coefficients,
        factor,
    )


def _eliminated_drift(
    walk: Walk,
    stds: Float[np.ndarray, "drifts"],
    information: Float[np.ndarray, "used 6 6"],
    weighted: Float[np.ndarray, "used 6 numbers"],
) -> tuple[
    Float[np.ndarray, "views drifts numbers"],
    Float[np.ndarray, "views drifts numbers"],
    Float[np.ndarray, "band drift"],
    float,
]:
    """Return what eliminates the drift from the normal equations, and a determinant.

    With A the information on the drift and B the right-hand sides, these are B, A^-1 B and the
    Cholesky factor of A; the logarithm is of det A times the determinant of the drift's prior
    covariance.

    Args:
        walk: the model.
        stds: standard deviations of the error that is new in a view.
        information: inverse covariances of the errors.
        weighted: the columns and errors times it.
    """
    used, size = walk.used, walk.by_drift.shape[2]
    transposed = walk.by_drift[used].swapaxes(1, 2)
    diagonal, right = (
        np.zeros((len(used), size, size)),
        np.zeros((len(used), size, weighted.shape[2])),
    )
    diagonal[used] = transposed @ information @ walk.by_drift[used]
    right[used] = transposed @ weighted
    # A drift of all views alike is a step of the holder: the first view has none.
    by_step = walk.to_step[1:] / stds[:, None]
    steps = by_step.swapaxes(1, 2) @ by_step
    diagonal, right[0] = diagonal[1:] + steps, 0.0
    diagonal[:-1] += steps[1:]
    factor = cholesky_banded(_banded(diagonal, -steps[1:]), lower=True, check_finite=False)
    solved = cho_solve_banded(
        (factor, True), right[1:].reshape(-1, right.shape[2]), check_finite=False
    )
    eliminated = np.zeros_like(right)
    eliminated[1:] = solved.reshape(right[1:].shape)
    log_determinant = 2.0 * np.log(factor[0]).sum() + 2.0 * len(steps) * np.log(stds).sum()
    return right, eliminated, factor, float(log_determinant)


def _sum_of_products(
    left: Float[np.ndarray, "views rows p"], right: Float[np.ndarray, "views rows q"]
) -> Float[np.ndarray, "p q"]:
    """Return the sum of transposed matrices times others over the views."""
    return left.reshape(-1, left.shape[2]).T @ right.reshape(-1, right.shape[2])


def _banded(
    diagonal: Float[np.ndarray, "steps n n"], above: Float[np.ndarray, "others n n"]
) -> Float[np.ndarray, "band numbers"]:
    """Return a symmetric block tridiagonal matrix, given in blocks, as LAPACK's lower band.

    Args:
        diagonal: blocks on the diagonal.
        above: blocks to the right of them, and transposed below them.
    """
    count, size = len(diagonal), diagonal.shape[1]
    band = np.zeros((2 * size, count, size))
    for column in range(size):
        for row in range(size):
            if row >= column:
                band[row - column, :, column] = diagonal[:, row, column]
            band[size + row - column, :-1, column] = above[:, column, row]
    return band.reshape(2 * size, -1)


def _told(columns: Float[np.ndarray, "views 6 n"]) -> Float[np.ndarray, "n told"]:
    """Return a basis of the steps of unknowns that change anything, for columns of any unit."""
    flat = columns.reshape(-1, columns.shape[2])
    size = np.linalg.norm(flat, axis=0)
    size = 1.0 / np.where(size > 0.0, size, 1.0)
    values, directions = np.linalg.svd(flat * size, full_matrices=False)[1:]
    return size[:, None] * directions[values > MIN_TOLD * values[0]].T


def _inverse(matrix: Float[np.ndarray, "n n"]) -> tuple[Float[np.ndarray, "n n"], float]:
    """Return the inverse of a normal matrix, and the logarithm of its determinant."""
    size = 1.0 / np.sqrt(np.diagonal(matrix))
    values, vectors = np.linalg.eigh(size[:, None] * matrix * size)
    values = np.maximum(values, ROUNDING * values[-1])
    scaled = size[:, None] * vectors
    log_determinant = float(np.log(values).sum() - 2.0 * np.log(size).sum())
    return (scaled / values) @ scaled.T, log_determinant
