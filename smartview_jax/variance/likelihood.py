"""Restricted likelihood (REML) of the standard deviations of pixels, poses and robot error field.

The residuals of a view determine the white noise within the view, but give almost no information on
errors that shift all of its points together. Therefore the likelihood is of statistics per view:
the best free pose of each view, and the camera of the fit with free poses, with the information of
their pixels. These statistics scatter by an *effective* pixel sigma, which is at least the white
one, and deviate from the poses predicted by the chain by the robot's random and smooth errors. All
parameters without a prior are marginalised with a flat prior (restricted likelihood), so that the
precision of a few views is not overrated.

After the chain is linearised once, the model is linear and Gaussian, and the likelihood is
evaluated without another pass over the pixels.

Reference: Patterson and Thompson, Recovery of inter-block information when block sizes are unequal,
1971.
"""

import dataclasses
from functools import cached_property

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from ..engine import Step, inverse_cholesky_factor
from ..runtime.array_namespace import AnyArray, AnyScalar, array_namespace
from .linearised_views import Kinds, LinearisedViews, kinds_of, rows_of_views
from .standard_deviations import AnyScalars, StandardDeviations

RELATIVE_RIDGE = 1e-13
"""Fraction by which the information of every shared parameter is increased.

It keeps the variance of an undetermined parameter finite.
"""


@eqx.filter_custom_jvp
def deviance(views: LinearisedViews, sigmas: StandardDeviations) -> AnyScalar:
    """Compute the deviance, -2 log of the restricted likelihood, up to a constant."""
    return marginalise(views, sigmas).deviance


@deviance.def_jvp
def _deviance_jvp(
    primals: tuple[LinearisedViews, StandardDeviations],
    tangents: tuple[LinearisedViews, StandardDeviations],
) -> tuple[AnyScalar, AnyScalar]:
    """Differentiate the deviance by the standard deviations in closed form.

    It takes half the work of differentiating through the factorisations.
    """
    if jax.tree.leaves(tangents[0]):
        return eqx.filter_jvp(lambda v, s: marginalise(v, s).deviance, primals, tangents)
    views, sigmas = primals
    marginal = marginalise(views, sigmas)
    derivatives = jax.tree.leaves(gradient(views, sigmas, marginal))
    sigma_tangents = jax.tree.leaves(tangents[1], is_leaf=lambda x: x is None)
    parts = [
        jnp.sum(derivative * tangent)
        for derivative, tangent in zip(derivatives, sigma_tangents, strict=True)
        if tangent is not None
    ]
    return marginal.deviance, sum(parts, jnp.zeros(()))


def posterior_mode_step(views: LinearisedViews, sigmas: StandardDeviations) -> Step:
    """Compute the step to the most probable parameters at given standard deviations of errors."""
    return marginalise(views, sigmas).step


@dataclasses.dataclass(frozen=True)
class Marginalisation:
    """The result of marginalising all fitted parameters, with the parts that its derivatives need.

    The covariances are computed on first use, because a deviance alone does not need them. With
    standard deviations for each of several searches, all arrays have these as first axis.

    Attributes:
        deviance: -2 log of the restricted likelihood, up to a constant; see `deviance`.
        step: step from the linearisation to the most probable parameters.
        prior_precision: prior precision of each shared parameter and of each view's own.
        whitened_border: border block of each view times `per_view_whitening`.
        per_view_whitening: inverse Cholesky factor of each view's own block of the posterior's
            information matrix.
        shared_whitening: inverse Cholesky factor of the shared parameters' information matrix, with
            the views' own parameters marginalised.
    """

    deviance: AnyScalars
    step: Step
    prior_precision: Step
    whitened_border: Float[AnyArray, "*searches views 6 shared"]
    per_view_whitening: Float[AnyArray, "*searches views 6 6"]
    shared_whitening: Float[AnyArray, "*searches shared shared"]

    # With A the information matrix, D_v a view's own block, B_v its border and K_v the gain, the
    # blocks of A^-1 are C (shared), -K_v C, and D_v^-1 + K_v C K_v^T.
    @cached_property
    def shared_covariance(self) -> Float[AnyArray, "*searches shared shared"]:
        """The covariance of the shared parameters, with the views' own parameters marginalised."""
        return self.shared_whitening.swapaxes(-1, -2) @ self.shared_whitening

    @cached_property
    def gain(self) -> Float[AnyArray, "*searches views 6 shared"]:
        """The inverse of each view's own block times its border block, `K_v = D_v^-1 B_v`."""
        return self.per_view_whitening.swapaxes(-1, -2) @ self.whitened_border

    @cached_property
    def gain_covariance(self) -> Float[AnyArray, "*searches views 6 shared"]:
        """The covariance of each view's own parameters with the shared ones, times -1."""
        # One product of two matrices, rather than one for each view.
        return (rows_of_views(self.gain) @ self.shared_covariance).reshape(self.gain.shape)

    @cached_property
    def per_view_inverse(self) -> Float[AnyArray, "*searches views 6 6"]:
        """The covariance of each view's own parameters for known shared parameters."""
        return self.per_view_whitening.swapaxes(-1, -2) @ self.per_view_whitening

    @cached_property
    def per_view_covariance(self) -> Float[AnyArray, "*searches views 6 6"]:
        """The covariance of each view's own parameters."""
        return self.per_view_inverse + self.gain_covariance @ self.gain.swapaxes(-1, -2)


def marginalise(views: LinearisedViews, sigmas: StandardDeviations) -> Marginalisation:
    """Marginalise all fitted parameters at given standard deviations of errors.

    Either may be given for several searches, as by `LinearisedViews.with_held_in_searches`.
    """
    # With p = 1 / sigma^2 = pixel_precision, M and g the views' matrix and gradient for 1 px,
    # W = prior_precision, o = offset_from_prior, n = statistic_count and
    # R = residual_sum_of_squares, the information matrix of the posterior and its gradient are
    # A = p M + W and h = p g + W o, the best step is s = -A^-1 h, and
    #
    # deviance = -n log p + p R + o^T W o + h^T s + log det A - log det W
    #
    # with W in the last determinant only for priors of unknown standard deviation.
    xp = array_namespace(views.gradient.shared, *sigmas)
    offset = views.offset_from_prior
    weights = sigmas.prior_weights(views.group_index, views.known_weight)
    prior_precision = Step(
        weights.shared**2, xp.where(views.per_view_free, weights.per_view**2, 0.0)
    )
    pixel_precision = xp.asarray(sigmas.pixel) ** -2.0
    shared, per_view, posterior_gradient = _posterior_equations(
        views, prior_precision, pixel_precision
    )

    # With D_v a view's own block, B_v its border, F_v D_v F_v^T = 1 and E_v = F_v B_v, the Schur
    # complement is S = A_shared - sum_v E_v^T E_v; with F S F^T = 1, the whitened gradients are
    # c_v = F_v h_v and c = F (h_shared - sum_v E_v^T c_v), and h^T A^-1 h = |c|^2 + sum_v |c_v|^2.
    per_view_whitening = inverse_cholesky_factor(per_view)
    whitened_border = (_expanded(pixel_precision, 3) * per_view_whitening) @ views.matrix.border
    border_rows = rows_of_views(whitened_border)
    border_columns = border_rows.swapaxes(-1, -2)
    shared_whitening = inverse_cholesky_factor(shared - border_columns @ border_rows)
    per_view_rhs = _times_vectors(per_view_whitening, posterior_gradient.per_view)
    all_rhs = per_view_rhs.reshape(border_rows.shape[:-1])
    shared_rhs = _times_vectors(
        shared_whitening, posterior_gradient.shared - _times_vectors(border_columns, all_rhs)
    )
    shared_step = xp.negative(_times_vectors(shared_whitening.swapaxes(-1, -2), shared_rhs))
    by_shared = _times_vectors(border_rows, shared_step).reshape(per_view_rhs.shape)
    per_view_step = _times_vectors(per_view_whitening.swapaxes(-1, -2), per_view_rhs + by_shared)
    step = Step(shared_step, xp.negative(per_view_step))

    penalty = xp.vecdot(prior_precision.shared, offset.shared**2) + (
        prior_precision.per_view * offset.per_view**2
    ).sum(axis=(-2, -1))
    gradient_step_product = -(xp.vecdot(shared_rhs, shared_rhs) + xp.vecdot(all_rhs, all_rhs))
    log_determinant = _log_determinant(shared_whitening) + _log_determinant(per_view_whitening).sum(
        axis=-1
    )
    value = (
        -views.statistic_count * xp.log(pixel_precision)
        + pixel_precision * views.residual_sum_of_squares
        + penalty
        + gradient_step_product
        + log_determinant
        - _log_prior_determinant(views, weights)
    )
    return Marginalisation(
        value, step, prior_precision, whitened_border, per_view_whitening, shared_whitening
    )


def _posterior_equations(
    views: LinearisedViews, prior_precision: Step, pixel_precision: AnyArray
) -> tuple[
    Float[AnyArray, "*searches shared shared"], Float[AnyArray, "*searches views 6 6"], Step
]:
    """Return the posterior's information of shared and of own parameters, and its gradient.

    The border between them is the pixels' alone.
    """
    xp = array_namespace(views.gradient.shared, pixel_precision)
    of_vectors, of_matrices, of_blocks = (_expanded(pixel_precision, axes) for axes in (1, 2, 3))
    offset = views.offset_from_prior
    shared = of_matrices * views.matrix.shared
    ridge = RELATIVE_RIDGE * _diagonal(shared)
    shared = with_added_diagonal(shared, prior_precision.shared + ridge)
    # A fixed correction has a zero column; 1 on the diagonal keeps the equations solvable.
    diagonal = xp.where(views.per_view_free, prior_precision.per_view, 1.0)
    per_view = with_added_diagonal(of_blocks * views.matrix.per_view, diagonal)
    posterior_gradient = Step(
        of_vectors * views.gradient.shared + prior_precision.shared * offset.shared,  # pyright: ignore[reportArgumentType]
        of_matrices * views.gradient.per_view + prior_precision.per_view * offset.per_view,  # pyright: ignore[reportArgumentType]
    )
    return shared, per_view, posterior_gradient


def _log_prior_determinant(views: LinearisedViews, weights: Step) -> AnyScalars:
    """Return the log-determinant of the priors with unknown standard deviations."""
    xp = array_namespace(weights.shared)
    shared = xp.log(xp.where(views.group_index >= 0, weights.shared**2, 1.0))
    per_view = xp.where(views.per_view_free, xp.log(weights.per_view**2), 0.0)
    return shared.sum(axis=-1) + per_view.sum(axis=(-2, -1))


def _expanded(values: AnyArray, axes: int) -> AnyArray:
    """Return an array, or a number, with so many more axes of length one at its end."""
    return values.reshape(*values.shape, *(1,) * axes)


def gradient(
    views: LinearisedViews,
    sigmas: StandardDeviations,
    marginal: Marginalisation,
    kinds: Kinds | None = None,
) -> StandardDeviations:
    """Compute the derivative of the deviance by every standard deviation.

    The derivative of the best step does not contribute, since the deviance is stationary there.

    Args:
        views: the linearised views.
        sigmas: standard deviations of all errors.
        marginal: result of `marginalise` at these.
        kinds: result of `kinds_of`, if it is known; None computes it.
    """
    if kinds is None:
        kinds = kinds_of(views, sigmas.field.shape[-1])
    # dD / d log w_j = w_j E[(o_j + s_j)^2] - 1 for the precision w_j of a prior, where the
    # posterior expectation is (o_j + s_j)^2 + C_jj with C = A^-1.
    xp = array_namespace(marginal.shared_whitening)
    prior_precision, step, pixel_gradient = marginal.prior_precision, marginal.step, views.gradient
    offset = views.offset_from_prior
    shared_offset, per_view_offset = offset.shared + step.shared, offset.per_view + step.per_view
    shared_variance = _diagonal(marginal.shared_covariance)
    per_view_variance = _diagonal(marginal.per_view_covariance)
    # Parameters without a prior of unknown standard deviation, and fixed ones, do not contribute.
    shared = xp.where(
        views.group_index >= 0,
        prior_precision.shared * (shared_offset**2 + shared_variance) - 1.0,
        0.0,
    )
    per_view = xp.where(
        views.per_view_free,
        prior_precision.per_view * (per_view_offset**2 + per_view_variance) - 1.0,
        0.0,
    )

    # dD / d log p = p (R + 2 g.s + s.M s) + tr(p M C) - n, in the notation of `marginalise`, with
    # p M s = -p g - W (o + s) at the best step, and tr(p M C) = parameter_count - tr(W C), the
    # effective number of parameters that the pixels determine.
    pixel_precision = xp.asarray(sigmas.pixel) ** -2.0
    of_vectors, of_matrices = pixel_precision[..., None], pixel_precision[..., None, None]
    effective_parameters = (
        views.per_view_free.sum(dtype=float)
        + shared.shape[-1]
        - xp.vecdot(prior_precision.shared, shared_variance)
        - (prior_precision.per_view * per_view_variance).sum(axis=(-2, -1))
    )
    shared_terms = of_vectors * pixel_gradient.shared - prior_precision.shared * shared_offset
    per_view_terms = (
        of_matrices * pixel_gradient.per_view - prior_precision.per_view * per_view_offset
    )
    by_log_precision = (
        pixel_precision * views.residual_sum_of_squares
        + xp.vecdot(shared_terms, step.shared)
        + (per_view_terms * step.per_view).sum(axis=(-2, -1))
        + effective_parameters
        - views.statistic_count
    )
    # Precision w = 1 / sigma^2: d log w / d sigma = -2 / sigma.
    return StandardDeviations(
        -2.0 * by_log_precision / sigmas.pixel,
        -2.0 * per_view[..., :3].sum(axis=(-2, -1)) / sigmas.translation,
        -2.0 * per_view[..., 3:].sum(axis=(-2, -1)) / sigmas.rotation,
        -2.0 * _times_vectors(kinds.groups, shared) / sigmas.field,
    )


def _times_vectors(
    matrices: Float[AnyArray, "*batch m n"], vectors: Float[AnyArray, "*batch n"]
) -> Float[AnyArray, "*batch m"]:
    """Multiply every matrix by the vector with the same index."""
    return (matrices @ vectors[..., None])[..., 0]


def _diagonal(matrices: Float[AnyArray, "*batch n n"]) -> Float[AnyArray, "*batch n"]:
    """Return the diagonals of matrices."""
    return matrices.diagonal(axis1=-2, axis2=-1)


def _log_determinant(whitening: Float[AnyArray, "*batch n n"]) -> Float[AnyArray, "*batch"]:
    """Compute the log-determinant of matrices from their inverse Cholesky factors."""
    xp = array_namespace(whitening)
    return -2.0 * xp.log(_diagonal(whitening)).sum(axis=-1)


def with_added_diagonal(
    matrices: Float[AnyArray, "*batch n n"], values: Float[AnyArray, "*batch n"]
) -> Float[AnyArray, "*batch n n"]:
    """Return matrices with values added to their diagonals."""
    if array_namespace(matrices, values) is jnp:
        identity = jnp.broadcast_to(jnp.eye(matrices.shape[-1]), matrices.shape)
        return matrices + identity * values[..., None, :]
    # `eye`, `diag` and `einsum` take longer than all of this for small matrices. A copy is
    # contiguous, so that every n+1-th entry of its rows in a row is on a diagonal.
    result, n = matrices.copy(), matrices.shape[-1]
    result.reshape(*matrices.shape[:-2], n * n)[..., :: n + 1] += values
    return result
