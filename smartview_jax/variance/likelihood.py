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
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ..engine import BlockArrow, Step, inverse_cholesky_factor
from ..runtime.array_namespace import AnyArray, AnyScalar, array_namespace
from ..runtime.modules import with_fields

ROBOT_SIGMA_FLOOR = 1e-8
"""Standard deviation, m or rad, at which an error of the robot counts as zero.

It is not smaller, so that its inverse square, times the square of a pose error of centimetres, does
not swamp the significant digits of the deviance.
"""

RELATIVE_RIDGE = 1e-13
"""Fraction by which the information of every shared parameter is increased.

It keeps the variance of an undetermined parameter finite.
"""

IS_POSE_KIND = np.repeat(np.eye(2), 3, axis=1)
"""One where a view's own parameter belongs to the translation (row 0) or the rotation (row 1)."""

_ONE = np.ones(1)


class LinearisedViews(NamedTuple):
    """The observations' normal equations for a pixel sigma of 1 px, and the layout of the priors.

    Attributes:
        matrix: normal equations of the free shared parameters and each view's own, without priors.
        gradient: gradient of half the sum of squared residuals.
        residual_sum_of_squares: sum of squared residuals at the linearisation minus the sum at the
            fit with free poses and a free camera, px^2.
        offset_from_prior: difference of the parameters from their prior means at the linearisation.
        known_weight: one over the standard deviation of the priors with known standard deviations.
        group_index: index of the group of unknown standard deviation of each shared parameter, -1
            for none.
        per_view_free: mask of the free parameters among each view's own six.
        statistic_count: number of statistics: free parameters of the camera, and of the views' own
            poses.
        white_sigma: standard deviation of the noise within views, px.
    """

    matrix: BlockArrow
    gradient: Step
    residual_sum_of_squares: AnyScalar
    offset_from_prior: Step
    known_weight: Float[AnyArray, "shared"]
    group_index: Int[AnyArray, "shared"]
    per_view_free: Bool[AnyArray, "views 6"]
    statistic_count: AnyScalar
    white_sigma: AnyScalar

    def with_held(self, held: Bool[AnyArray, "shared"]) -> "LinearisedViews":
        """Return the views with some shared parameters held at their prior means, and left out."""
        # The change to the prior mean is d = -offset for the held parameters (index h):
        #     g -> g + M_h d,   R -> R + 2 g_h^T d + d^T M_hh d
        kept, matrix, gradient = ~held, self.matrix, self.gradient
        change = -self.offset_from_prior.shared[held]
        gradient_change = matrix.shared[:, held] @ change
        return self._replace(
            matrix=with_fields(
                matrix, shared=matrix.shared[kept][:, kept], border=matrix.border[:, :, kept]
            ),
            gradient=Step(
                (gradient.shared + gradient_change)[kept],
                gradient.per_view + matrix.border[:, :, held] @ change,
            ),
            residual_sum_of_squares=self.residual_sum_of_squares
            + (2.0 * gradient.shared + gradient_change)[held] @ change,
            offset_from_prior=Step(
                self.offset_from_prior.shared[kept], self.offset_from_prior.per_view
            ),
            known_weight=self.known_weight[kept],
            group_index=self.group_index[kept],
        )

    def lower_bounds(self, component_count: int) -> Float[AnyArray, "kinds"]:
        """Return all lower bounds, in the order of `StandardDeviations.vector`."""
        xp = array_namespace(self.white_sigma)
        white_sigma = xp.reshape(xp.asarray(self.white_sigma), 1)
        return xp.concatenate([white_sigma, xp.full(component_count - 1, ROBOT_SIGMA_FLOOR)])


class Kinds(NamedTuple):
    """The kinds of random numbers: each kind has one unknown standard deviation.

    Attributes:
        groups: one where a shared parameter belongs to a group of the field, zero elsewhere.
        counts: number of random numbers of each kind, in the order of `StandardDeviations.vector`.
    """

    groups: Float[AnyArray, "groups shared"]
    counts: Float[AnyArray, "kinds"]


class StandardDeviations(NamedTuple):
    """The standard deviations of all errors, all positive.

    Their squares are the variance components.

    Attributes:
        pixel: effective pixel sigma, px.
        translation: standard deviation of the translation of reported poses, m.
        rotation: standard deviation of the rotation of reported poses, rad.
        field: standard deviation of the coefficients in each group of the robot error field;
            `ROBOT_SIGMA_FLOOR` disables a group.
    """

    pixel: AnyScalar
    translation: AnyScalar
    rotation: AnyScalar
    field: Float[AnyArray, "groups"]

    @property
    def vector(self) -> Float[AnyArray, "kinds"]:
        """The standard deviations as a vector: pixel, translation, rotation, field."""
        xp = array_namespace(*self)
        pixel_and_pose = xp.array([self.pixel, self.translation, self.rotation])
        return xp.concatenate([pixel_and_pose, self.field])

    @classmethod
    def from_vector(cls, vector: Float[AnyArray, "kinds"]) -> "StandardDeviations":
        """Create the standard deviations from a vector in the order of `vector`."""
        return cls(vector[0], vector[1], vector[2], vector[3:])

    def prior_weights(
        self, group_index: Int[AnyArray, "shared"], known_weight: Float[AnyArray, "shared"]
    ) -> Step:
        """Return one over the prior standard deviation of every parameter.

        The views' own have one common row.

        Args:
            group_index: group of each shared parameter, as in `LinearisedViews`.
            known_weight: weights of the parameters that belong to no group.
        """
        xp = array_namespace(*self)
        # Index -1 (no group) reads the one at the end, which `where` then discards.
        field = xp.concatenate([self.field, _ONE])[group_index]
        pose_sigmas = self.translation * IS_POSE_KIND[0] + self.rotation * IS_POSE_KIND[1]
        return Step(xp.where(group_index >= 0, 1.0 / field, known_weight), 1.0 / pose_sigmas[None])


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

    The covariances are computed on first use, because a deviance alone does not need them.

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

    deviance: AnyScalar
    step: Step
    prior_precision: Step
    whitened_border: Float[AnyArray, "views 6 shared"]
    per_view_whitening: Float[AnyArray, "views 6 6"]
    shared_whitening: Float[AnyArray, "shared shared"]

    # With A the information matrix, D_v a view's own block, B_v its border and K_v the gain, the
    # blocks of A^-1 are C (shared), -K_v C, and D_v^-1 + K_v C K_v^T.
    @cached_property
    def shared_covariance(self) -> Float[AnyArray, "shared shared"]:
        """The covariance of the shared parameters, with the views' own parameters marginalised."""
        return self.shared_whitening.T @ self.shared_whitening

    @cached_property
    def gain(self) -> Float[AnyArray, "views 6 shared"]:
        """The inverse of each view's own block times its border block, `K_v = D_v^-1 B_v`."""
        return self.per_view_whitening.swapaxes(1, 2) @ self.whitened_border

    @cached_property
    def gain_covariance(self) -> Float[AnyArray, "views 6 shared"]:
        """The covariance of each view's own parameters with the shared ones, times -1."""
        # One product of two matrices, rather than one for each view.
        return (rows_of_views(self.gain) @ self.shared_covariance).reshape(self.gain.shape)

    @cached_property
    def per_view_inverse(self) -> Float[AnyArray, "views 6 6"]:
        """The covariance of each view's own parameters for known shared parameters."""
        return self.per_view_whitening.swapaxes(1, 2) @ self.per_view_whitening

    @cached_property
    def per_view_covariance(self) -> Float[AnyArray, "views 6 6"]:
        """The covariance of each view's own parameters."""
        return self.per_view_inverse + self.gain_covariance @ self.gain.swapaxes(1, 2)


def marginalise(views: LinearisedViews, sigmas: StandardDeviations) -> Marginalisation:
    """Marginalise all fitted parameters at given standard deviations of errors."""
    # With p = 1 / sigma^2 = pixel_precision, M and g the views' matrix and gradient for 1 px,
    # W = prior_precision, o = offset_from_prior, n = statistic_count and
    # R = residual_sum_of_squares, the information matrix of the posterior and its gradient are
    # A = p M + W and h = p g + W o, the best step is s = -A^-1 h, and
    #
    # deviance = -n log p + p R + o^T W o + h^T s + log det A - log det W
    #
    # with W in the last determinant only for priors of unknown standard deviation.
    xp = array_namespace(views.gradient.shared, *sigmas)
    has_unknown_sigma = views.group_index >= 0
    matrix, offset = views.matrix, views.offset_from_prior
    weights = sigmas.prior_weights(views.group_index, views.known_weight)
    prior_precision = Step(
        weights.shared**2, xp.where(views.per_view_free, weights.per_view**2, 0.0)
    )
    pixel_precision = sigmas.pixel**-2

    shared = pixel_precision * matrix.shared
    ridge = RELATIVE_RIDGE * shared.diagonal()
    shared = with_added_diagonal(shared, prior_precision.shared + ridge)
    # A fixed correction has a zero column; 1 on the diagonal keeps the equations solvable.
    diagonal = xp.where(views.per_view_free, prior_precision.per_view, 1.0)
    per_view = with_added_diagonal(pixel_precision * matrix.per_view, diagonal)
    shared_gradient = (
        pixel_precision * views.gradient.shared + prior_precision.shared * offset.shared
    )
    per_view_gradient = (
        pixel_precision * views.gradient.per_view + prior_precision.per_view * offset.per_view
    )

    # With D_v a view's own block, B_v its border, F_v D_v F_v^T = 1 and E_v = F_v B_v, the Schur
    # complement is S = A_shared - sum_v E_v^T E_v; with F S F^T = 1, the whitened gradients are
    # c_v = F_v h_v and c = F (h_shared - sum_v E_v^T c_v), and h^T A^-1 h = |c|^2 + sum_v |c_v|^2.
    per_view_whitening = inverse_cholesky_factor(per_view)
    whitened_border = (pixel_precision * per_view_whitening) @ matrix.border
    border_rows = rows_of_views(whitened_border)
    shared_whitening = inverse_cholesky_factor(shared - border_rows.T @ border_rows)
    per_view_rhs = _times_vectors(per_view_whitening, per_view_gradient)
    shared_rhs = shared_whitening @ (shared_gradient - border_rows.T @ per_view_rhs.reshape(-1))
    shared_step = xp.negative(shared_whitening.T @ shared_rhs)
    per_view_step = _times_vectors(
        per_view_whitening.swapaxes(1, 2),
        per_view_rhs + (border_rows @ shared_step).reshape(per_view_rhs.shape),
    )
    step = Step(shared_step, xp.negative(per_view_step))

    penalty = (
        prior_precision.shared @ offset.shared**2
        + (prior_precision.per_view * offset.per_view**2).sum()
    )
    gradient_step_product = -(shared_rhs @ shared_rhs + (per_view_rhs**2).sum())
    log_determinant = _log_determinant(shared_whitening) + _log_determinant(per_view_whitening)
    log_prior_determinant = (
        xp.log(xp.where(has_unknown_sigma, prior_precision.shared, 1.0)).sum()
        + xp.where(views.per_view_free, xp.log(weights.per_view**2), 0.0).sum()
    )
    value = (
        -views.statistic_count * xp.log(pixel_precision)
        + pixel_precision * views.residual_sum_of_squares
        + penalty
        + gradient_step_product
        + log_determinant
        - log_prior_determinant
    )
    return Marginalisation(
        value, step, prior_precision, whitened_border, per_view_whitening, shared_whitening
    )


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
        kinds = kinds_of(views, len(sigmas.field))
    # dD / d log w_j = w_j E[(o_j + s_j)^2] - 1 for the precision w_j of a prior, where the
    # posterior expectation is (o_j + s_j)^2 + C_jj with C = A^-1.
    xp = array_namespace(marginal.shared_whitening)
    prior_precision, step, pixel_gradient = marginal.prior_precision, marginal.step, views.gradient
    offset = views.offset_from_prior
    shared_offset, per_view_offset = offset.shared + step.shared, offset.per_view + step.per_view
    shared_variance = marginal.shared_covariance.diagonal()
    per_view_variance = marginal.per_view_covariance.diagonal(axis1=1, axis2=2)
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
    pixel_precision = sigmas.pixel**-2
    effective_parameters = (
        views.per_view_free.sum(dtype=float)
        + len(shared)
        - prior_precision.shared @ shared_variance
        - (prior_precision.per_view * per_view_variance).sum()
    )
    shared_terms = pixel_precision * pixel_gradient.shared - prior_precision.shared * shared_offset
    per_view_terms = (
        pixel_precision * pixel_gradient.per_view - prior_precision.per_view * per_view_offset
    )
    by_log_precision = (
        pixel_precision * views.residual_sum_of_squares
        + shared_terms @ step.shared
        + (per_view_terms * step.per_view).sum()
        + effective_parameters
        - views.statistic_count
    )
    # Precision w = 1 / sigma^2: d log w / d sigma = -2 / sigma.
    return StandardDeviations(
        -2.0 * by_log_precision / sigmas.pixel,
        -2.0 * per_view[:, :3].sum() / sigmas.translation,
        -2.0 * per_view[:, 3:].sum() / sigmas.rotation,
        -2.0 * (kinds.groups @ shared) / sigmas.field,
    )


def rows_of_views(
    blocks: Float[AnyArray, "views own columns"],
) -> Float[AnyArray, "rows columns"]:
    """Return the blocks of all views one below the other, as a single matrix."""
    return blocks.reshape(blocks.shape[0] * blocks.shape[1], blocks.shape[2])


def _times_vectors(
    matrices: Float[AnyArray, "views 6 6"], vectors: Float[AnyArray, "views 6"]
) -> Float[AnyArray, "views 6"]:
    """Multiply the matrix of every view by the vector of that view."""
    return (matrices @ vectors[..., None])[..., 0]


def _log_determinant(whitening: Float[AnyArray, "*batch n n"]) -> AnyScalar:
    """Compute the log-determinant of matrices from their inverse Cholesky factors."""
    xp = array_namespace(whitening)
    return -2.0 * xp.log(whitening.diagonal(axis1=-2, axis2=-1)).sum()


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


def kinds_of(views: LinearisedViews, groups: int) -> Kinds:
    """Return the kind of each random number of the views, given the number of groups."""
    xp = array_namespace(views.group_index)
    indicator = (views.group_index[None] == xp.arange(groups)[:, None]).astype(float)
    robot = xp.sum(views.per_view_free.reshape(-1, 2, 3), axis=(0, 2), dtype=float)
    statistics = xp.reshape(xp.asarray(views.statistic_count), 1)
    return Kinds(indicator, xp.concatenate([statistics, robot, xp.sum(indicator, axis=1)]))
