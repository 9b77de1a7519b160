"""Estimate a pose from edges whose errors have heavy tails, by expectation-maximisation.

Most edges of a picture are accurate to a hundredth of a pixel, as their points say; a few are off
by many times that, because of a shadow, a rounded corner or print next to them. One Gaussian for
all edges trusts the exact ones too little and the others too much. Here the errors of an edge have
a bivariate Student's t distribution: a Gaussian whose variance is the variance of the edge's points
times an unknown factor (Lange, Little and Taylor, "Robust statistical modeling using the t
distribution", 1989). How heavy the tails are differs from picture to picture: the edges themselves
tell, and what they leave open is averaged over.

The light that a smooth surface turns into sight displaces its outline (`shading`). To first order
one light displaces all outlines of a view, and is an unknown; the rest still differs little from an
outline to the next. A fit that takes these errors as independent is then less accurate than it
states. How much they share is seen in the residuals, whose neighbours have the same sign.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...engine import covariance_factor
from .pose_equations import CommonErrors, PoseEquations, PoseStep, solve_pose, whitening

DEGREES_OF_FREEDOM = np.array([2.0, 3.0, 5.0, 10.0, 30.0, 1000.0])
"""Degrees of freedom of Student's t that are tried, equally probable beforehand.

The first makes one edge in ten err by more than four times its scale; the last is a Gaussian.
"""

NUMBERS = 2
"""Numbers of an edge: its distance from the prediction and its tilt."""

INFORMATION = (DEGREES_OF_FREEDOM + NUMBERS) / (DEGREES_OF_FREEDOM + NUMBERS + 2.0)
"""Fisher information of Student's t of scale one, relative to a Gaussian error."""

EDGE_SIGMAS = tuple(np.geomspace(0.0025, 1.5, 20).tolist())
"""Scales that are tried for an error common to all edges, px, equally probable beforehand.

No such error is as probable as one of any scale.
"""

TILTS = (0.0, 0.5, 1.0)
"""Tilts by such an error over its displacements, equally probable beforehand.

A rounded corner displaces an edge without a tilt; the grain of a surface tilts it by as much.
"""

MAX_LOG_LIKELIHOOD_LOSS = 10.0
"""Log-likelihood below the best scale's at which larger scales are no longer tried."""

MAX_ITERATIONS = 100
"""Largest number of iterations for one scale."""

CONVERGED = 0.01
"""Length of a step, in standard deviations, at which the iteration ends."""


class HeavyTailedStep(NamedTuple):
    """The solution of the equations of edges with heavy-tailed errors.

    Attributes:
        step: the solution, its covariance and its parts.
        equations: the equations that it solves, with the noise of Gaussian errors of equal
            information.
        squared: expected square of each edge's two errors, over their scale; two on average for
            Gaussian errors of this scale.
        edge_sigma: estimated standard deviation of the edges' displacements beyond their points'
            noise, px.
    """

    step: PoseStep
    equations: PoseEquations
    squared: Float[np.ndarray, "edges"]
    edge_sigma: float


def solve_heavy_tailed(equations: PoseEquations, errors: CommonErrors) -> HeavyTailedStep:
    """Return the likeliest pose if the errors of whole edges have Student's t distribution.

    Its scale is the noise of the edge's points plus an error common to all edges, as of grain, a
    rounded object or an inexact model.

    Args:
        equations: two of each edge, one after the other, with independent noise.
        errors: the errors that all edges share.

    Raises:
        UndeterminedPoseError: the equations leave the pose undetermined.
    """
    unknowns = _Unknowns.of(equations, errors)
    points = np.diagonal(equations.noise).reshape(-1, NUMBERS)
    weights = np.ones(len(points))
    if equations.by_light is not None:
        # Where something shades a part of the object, its outline is displaced otherwise.
        by_light = np.abs(equations.by_light).sum(axis=1).reshape(-1, NUMBERS)
        fit, of_light, _ = _averaged(unknowns, points, [by_light], weights)
        points, weights = points + of_light, fit.weights
    shapes = [np.array([1.0, tilt]) for tilt in TILTS]
    fit, of_edges, missing = _averaged(unknowns, points, shapes, weights)
    noise = (points + of_edges) / fit.weights[:, None]
    light, common = equations.by_light, 0.0
    if light is not None:
        by_light = light.sum(axis=1)
        alike = np.repeat(np.repeat(light_correlations(equations), 2, axis=0), 2, axis=1)
        shared = alike * np.outer(by_light, by_light)
        missing = missing + unknowns.covariance_by_shared(noise.ravel(), shared)
        common = light @ light.T
    # In the span of the derivatives a covariance leaves the solution as it is.
    common = common + equations.by_pose @ missing @ equations.by_pose.T
    gaussian = equations._replace(noise=np.diag(noise.ravel()) + common, by_light=None)
    edge_sigma = float(np.sqrt(of_edges[0] / (fit.tails @ INFORMATION)))
    return HeavyTailedStep(solve_pose(gaussian, errors), gaussian, fit.squared, edge_sigma)


class _Unknowns(NamedTuple):
    """Equations for the pose and for the common errors, as independent unknowns.

    Attributes:
        residuals: measured minus predicted, px.
        derivatives: by the tangent of the pose, and by the common errors and the light in standard
            deviations.
        prior: prior information on the unknowns; on the pose only about the axis of a round object.
    """

    residuals: Float[np.ndarray, "n"]
    derivatives: Float[np.ndarray, "n unknowns"]
    prior: Float[np.ndarray, "unknowns unknowns"]

    @classmethod
    def of(cls, equations: PoseEquations, errors: CommonErrors) -> "_Unknowns":
        """Return the equations with the common errors as unknowns.

        Raises:
            UndeterminedPoseError: they leave the pose undetermined.
        """
        J = equations.by_pose
        # Raises where the pose is undetermined, whatever the weights.
        whitening(J.T @ J + errors.turns)
        common = [
            equations.by_calibration @ covariance_factor(errors.calibration),
            equations.by_vertices @ covariance_factor(errors.vertices),
        ]
        if equations.by_light is not None:
            common.append(equations.by_light)
        derivatives = np.concatenate([J, *common], axis=1)
        prior = np.diag(np.repeat([0.0, 1.0], [6, derivatives.shape[1] - 6]))
        prior[:6, :6] = errors.turns
        return cls(equations.residuals, derivatives, prior)

    def covariance_by_shared(
        self, variances: Float[np.ndarray, "n"], shared: Float[np.ndarray, "n n"]
    ) -> Float[np.ndarray, "6 6"]:
        """Return what a pose's covariance lacks because edges share errors.

        Args:
            variances: of the equations' independent errors.
            shared: covariance of the shared errors, but for its size.
        """
        rows = self.derivatives / variances[:, None]
        whitened = whitening(self.derivatives.T @ rows + self.prior)
        solved = whitened.T @ (whitened @ rows.T)
        remaining = np.eye(len(variances)) - self.derivatives @ solved
        size = variance_of_shared(remaining @ self.residuals, remaining, variances, shared)
        return size * solved[:6] @ shared @ solved[:6].T


class _Fit(NamedTuple):
    """A pose for given scales of the edges' errors, with the resulting weights.

    Attributes:
        solution: the unknowns.
        information: of the solution, the inverse of its covariance.
        whitened: a root of its covariance, `W^T W`.
        squares: of the errors of each edge's numbers, px^2.
        squared: as in `HeavyTailedStep`.
        tails: probabilities of `DEGREES_OF_FREEDOM`.
        weights: updated information of each edge, over the information of a Gaussian error.
    """

    solution: Float[np.ndarray, "unknowns"]
    information: Float[np.ndarray, "unknowns unknowns"]
    whitened: Float[np.ndarray, "unknowns unknowns"]
    squares: Float[np.ndarray, "edges 2"]
    squared: Float[np.ndarray, "edges"]
    tails: Float[np.ndarray, "freedoms"]
    weights: Float[np.ndarray, "edges"]

    def log_likelihood(
        self, prior: Float[np.ndarray, "unknowns unknowns"], variances: Float[np.ndarray, "edges 2"]
    ) -> float:
        """Return the log-likelihood of the scales, with the unknowns integrated out (Laplace).

        The common errors have their prior, and integrating the unknowns out adds log|A| / 2.
        """
        of_edges = np.logaddexp.reduce(_log_tails((self.squares / variances).sum(axis=1)))
        common = self.solution @ prior @ self.solution
        determinant = -2.0 * np.log(np.diagonal(self.whitened)).sum()
        return float(of_edges) - 0.5 * float(np.log(variances).sum() + common + determinant)


def _log_tails(squared: Float[np.ndarray, "edges"]) -> Float[np.ndarray, "freedoms"]:
    """Return the log-likelihoods of `DEGREES_OF_FREEDOM`, but for a constant.

    -log p = log|V| / 2 + (nu + 2) / 2 log(1 + e^T V^-1 e / nu) for two numbers.

    Args:
        squared: square of each edge's two errors, over their scale.
    """
    nu = DEGREES_OF_FREEDOM
    return -0.5 * (nu + NUMBERS) * np.log1p(squared[:, None] / nu).sum(axis=0)


class _Averaged(NamedTuple):
    """A fit whose edges have a further error of unknown scale, averaged over.

    Attributes:
        fit: with the expected variance of that error.
        variance: the expected variance of the two numbers, px^2.
        spread: of the poses for all scales about that fit; their expected covariance lacks it.
    """

    fit: _Fit
    variance: Float[np.ndarray, "*edges 2"]
    spread: Float[np.ndarray, "6 6"]


def _averaged(
    unknowns: _Unknowns,
    variances: Float[np.ndarray, "edges 2"],
    shapes: Sequence[Float[np.ndarray, "*edges 2"]],
    weights: Float[np.ndarray, "edges"],
) -> _Averaged:
    """Return the fit with an error that all edges have, averaged over the error's scale.

    Few edges cannot tell a small scale from none, so that the likeliest one would often be zero.

    Args:
        unknowns: the equations.
        variances: of the edges' other errors.
        shapes: standard deviations of the two numbers by an error of the scale one; any of these.
        weights: initial weights of the edges.
    """
    further = [np.zeros_like(shapes[0])]
    fits = [_fit(unknowns, variances, weights)]
    logs = [fits[0].log_likelihood(unknowns.prior, variances)]
    for shape in shapes:
        # The weights of one scale are a good start for the next.
        fit, best = fits[0], -np.inf
        for sigma in EDGE_SIGMAS:
            variance = np.square(sigma * shape)
            fit = _fit(unknowns, variances + variance, fit.weights)
            log = fit.log_likelihood(unknowns.prior, variances + variance)
            further.append(variance)
            fits.append(fit)
            logs.append(log)
            best = max(best, log)
            if log < best - MAX_LOG_LIKELIHOOD_LOSS:
                break
    probabilities = np.exp(np.array(logs) - max(logs))
    probabilities[0] *= len(shapes) * len(EDGE_SIGMAS)
    probabilities /= probabilities.sum()
    variance = np.tensordot(probabilities, np.stack(further), axes=1)
    fit = _fit(unknowns, variances + variance, fits[int(probabilities.argmax())].weights)
    off = np.stack([each.solution[:6] - fit.solution[:6] for each in fits])
    return _Averaged(fit, variance, (off.T * probabilities) @ off)


def _fit(
    unknowns: _Unknowns,
    variances: Float[np.ndarray, "edges 2"],
    weights: Float[np.ndarray, "edges"],
) -> _Fit:
    """Return the likeliest pose for given scales, from initial weights of the edges."""
    fit = _reweighted(unknowns, variances, weights)
    for _ in range(MAX_ITERATIONS):
        before, fit = fit, _reweighted(unknowns, variances, fit.weights)
        change = fit.solution - before.solution
        if change @ fit.information @ change < CONVERGED**2:
            break
    return fit


def _reweighted(
    unknowns: _Unknowns,
    variances: Float[np.ndarray, "edges 2"],
    weights: Float[np.ndarray, "edges"],
) -> _Fit:
    """Return the pose that fits best with given weights of the edges, and updated weights.

    Given its factor w an edge is Gaussian with the variance v / w, and given the pose the expected
    factor is (nu + 2) / (nu + s), with s the expected square of its errors over v. It is one on
    average, more than the information. The heaviness nu of the tails has its probabilities.
    """
    r, G, prior = unknowns
    # Least squares A x = G^T W r, A = G^T W G + prior. The covariance of x adds to the expected
    # squares of the errors: e^2 + diag(G A^-1 G^T). With W_A^T W_A = A^-1 this is the sum of
    # squares in each column of W_A G^T, which rounding cannot make negative.
    rows = (weights[:, None] / variances).reshape(-1, 1) * G
    information = G.T @ rows + prior
    whitened = whitening(information)
    solution = whitened.T @ (whitened @ (rows.T @ r))
    squares = ((r - G @ solution) ** 2).reshape(-1, NUMBERS)
    spread = G @ whitened.T
    spread = np.einsum("ij,ij->i", spread, spread).reshape(-1, NUMBERS)
    squared = ((squares + spread) / variances).sum(axis=1)
    logs, nu = _log_tails(squared), DEGREES_OF_FREEDOM
    tails = np.exp(logs - np.logaddexp.reduce(logs))
    weights = ((nu + NUMBERS) / (nu + squared[:, None])) @ (tails * INFORMATION)
    return _Fit(solution, information, whitened, squares, squared, tails, weights)


def light_correlations(equations: PoseEquations) -> Float[np.ndarray, "edges edges"]:
    """Return the correlations between the errors of different outlines by an unknown light.

    A distant light displaces an outline by its part along the view, if it is on the outline. For
    all directions of the light, equally probable, it is on both of two outlines at an angle a with
    the probability (1 - a / pi) / 2, and on one with 1 / 2.

    Args:
        equations: two of each edge, with the light of each view, which only outlines have.

    Returns:
        One on the diagonal; zero between edges of two views, and where an edge is no outline.
    """
    assert equations.by_light is not None
    # A shift of the object moves an outline across itself: along the surface's normal.
    normals = equations.by_pose[::2, :3]
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    angles = np.arccos(np.clip(normals @ normals.T, -1.0, 1.0))
    is_lit = np.abs(equations.by_light[::2]) > 0.0
    return np.where(is_lit @ is_lit.T, 1.0 - angles / np.pi, 0.0)


def variance_of_shared(
    residuals: Float[np.ndarray, "n"],
    remaining: Float[np.ndarray, "n n"],
    variances: Float[np.ndarray, "n"],
    shared: Float[np.ndarray, "n n"],
) -> float:
    """Return the size of an error that neighbours share, from the products of their residuals.

    A fit absorbs a part of it. The products of different residuals have their expected values for
    the size returned (Rao, "Estimation of variance and covariance components - MINQUE theory",
    1971).

    Args:
        residuals: of a fit by generalised least squares; some unknowns may have a prior.
        remaining: share of an error that is left in the residuals.
        variances: of the independent errors.
        shared: covariance of the shared errors for the size one.
    """
    # Products weighted by T = S / (v v^T), zero on the diagonal, of r = M (G u + e + s). With the
    # unknowns u of a prior P, M (V + G P G^T) M^T = M V, so that E = tr(T (M V + size M S M^T)).
    weights = shared / np.outer(variances, variances)
    np.fill_diagonal(weights, 0.0)
    expected = (weights * remaining * variances).sum()
    by_size = ((remaining.T @ weights @ remaining) * shared).sum()
    excess = residuals @ weights @ residuals - expected
    return float(excess / by_size) if min(excess, by_size) > 0.0 else 0.0
