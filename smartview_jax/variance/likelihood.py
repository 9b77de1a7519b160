"""Restricted likelihood (REML) of the standard deviations of pixels, poses and robot error field.

The residuals of a view determine the white noise within the view, but give almost no information on
errors that shift all of its points together. The likelihood is therefore that of statistics per
view: the best free pose of each view, and the camera of the fit with free poses, with the
information that their pixels give. These statistics scatter by an *effective* pixel sigma, which is
not smaller than the white one, and about the poses predicted by the chain by the robot's random and
smooth errors. Everything that is fitted without a prior is marginalised with a flat prior
(restricted likelihood), so that a few views are not rated more precise than they are.

After the chain is linearised once, the model is linear and Gaussian, and the likelihood is
evaluated without another pass over the pixels.

Reference: Patterson and Thompson, Recovery of inter-block information when block sizes are unequal,
1971.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Bool, Float, Int

from ..engine import BlockArrow, Elimination, SchurCholesky, Step

ROBOT_SIGMA_FLOOR = 1e-8
"""Standard deviation, m or rad, at which an error of the robot counts as zero.

It is not smaller because its inverse square, times the square of centimetres by which poses may be
wrong, must not cost the deviance its significant digits.
"""

RELATIVE_RIDGE = 1e-13
"""Fraction of its own information added to that of every shared parameter.

The variance of a parameter that no view determines then stays finite.
"""


class LinearisedViews(eqx.Module):
    """The observations' normal equations for a pixel sigma of 1 px, and the layout of the priors.

    Attributes:
        matrix: normal equations of the free shared parameters and each view's own, without priors.
        gradient: gradient of half the sum of squared residuals.
        residual_sum_of_squares: sum of squared residuals at the linearisation, px^2, minus that of
            the fit with free poses and a free camera.
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
    residual_sum_of_squares: Float[Array, ""]
    offset_from_prior: Step
    known_weight: Float[Array, "shared"]
    group_index: Array
    per_view_free: Bool[Array, "views 6"]
    statistic_count: Float[Array, ""]
    white_sigma: Float[Array, ""]

    def with_field(
        self,
        field_jacobian: Float[Array, "views 6 coefficients"],
        group_index: np.ndarray,
        non_field_count: int,
    ) -> "LinearisedViews":
        """Return the same views with another robot error field, whose coefficients are still zero.

        The pixels are not needed again, since the effect of a field on a view is a twist, and each
        view's own six parameters are a twist as well.

        Args:
            field_jacobian: derivatives of the field, as its `jacobian` returns them.
            group_index: group index of every coefficient.
            non_field_count: number of shared parameters that do not belong to a field; they come
                first.
        """
        # With T_v the derivative of a view's correction by the coefficients, the new columns are
        # the view's own columns times T_v: sum_v B_v^T T_v, sum_v T_v^T D_v T_v, and D_v T_v in the
        # border.
        correction_jacobian, count = -field_jacobian, len(group_index)
        matrix, border = self.matrix, self.matrix.border[:, :, :non_field_count]
        field_border = matrix.per_view @ correction_jacobian
        cross_block = jnp.einsum("vki,vkj->ij", border, correction_jacobian)
        field_block = jnp.einsum("vki,vkj->ij", correction_jacobian, field_border)
        field_gradient = jnp.einsum("vki,vk->i", correction_jacobian, self.gradient.per_view)
        offset = self.offset_from_prior
        return dataclasses.replace(
            self,
            matrix=BlockArrow(
                jnp.block(
                    [
                        [matrix.shared[:non_field_count, :non_field_count], cross_block],
                        [cross_block.T, field_block],
                    ]
                ),
                jnp.concatenate([border, field_border], axis=2),
                matrix.per_view,
            ),
            gradient=Step(
                jnp.concatenate([self.gradient.shared[:non_field_count], field_gradient]),
                self.gradient.per_view,
            ),
            offset_from_prior=Step(
                jnp.pad(offset.shared[:non_field_count], (0, count)), offset.per_view
            ),
            known_weight=jnp.pad(self.known_weight[:non_field_count], (0, count)),
            group_index=jnp.concatenate(
                [self.group_index[:non_field_count], jnp.asarray(group_index)]
            ),
        )

    def lower_bounds(self, component_count: int) -> Float[Array, "kinds"]:
        """Return all lower bounds, in the order of `StandardDeviations.vector`."""
        return jnp.full(component_count, ROBOT_SIGMA_FLOOR).at[0].set(self.white_sigma)


class StandardDeviations(eqx.Module):
    """The standard deviations of all errors, all positive.

    Their squares are the variance components.

    Attributes:
        pixel: effective pixel sigma, px.
        translation: standard deviation of the translation of reported poses, m.
        rotation: standard deviation of the rotation of reported poses, rad.
        field: standard deviation of the coefficients in each group of the robot error field;
            `ROBOT_SIGMA_FLOOR` disables a group.
    """

    pixel: Float[Array, ""]
    translation: Float[Array, ""]
    rotation: Float[Array, ""]
    field: Float[Array, "groups"]

    @property
    def vector(self) -> Float[Array, "kinds"]:
        """The standard deviations as a vector: pixel, translation, rotation, field."""
        return jnp.concatenate(
            [jnp.stack([self.pixel, self.translation, self.rotation]), self.field]
        )

    @classmethod
    def from_vector(cls, vector: Float[Array, "kinds"]) -> "StandardDeviations":
        """Create the standard deviations from a vector in the order of `vector`."""
        return cls(vector[0], vector[1], vector[2], vector[3:])

    def prior_weights(
        self, group_index: Int[Array, "shared"], known_weight: Float[Array, "shared"]
    ) -> Step:
        """Return one over the prior standard deviation of every parameter.

        The views' own have one common row.

        Args:
            group_index: group of each shared parameter, as in `LinearisedViews`.
            known_weight: weights of the parameters that belong to no group.
        """
        # Index -1 (no group) reads the one at the end, which `where` then discards.
        field = jnp.concatenate([self.field, jnp.ones(1)])[group_index]
        pose_sigmas = jnp.repeat(jnp.stack([self.translation, self.rotation]), 3)
        return Step(jnp.where(group_index >= 0, 1.0 / field, known_weight), 1.0 / pose_sigmas[None])


@eqx.filter_custom_jvp
def deviance(views: LinearisedViews, sigmas: StandardDeviations) -> Float[Array, ""]:
    """Compute the deviance, -2 log of the restricted likelihood, up to a constant."""
    return marginalise(views, sigmas).deviance


@deviance.def_jvp
def _deviance_jvp(
    primals: tuple[LinearisedViews, StandardDeviations],
    tangents: tuple[LinearisedViews, StandardDeviations],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
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


class Marginalisation(eqx.Module):
    """The result of marginalising all fitted parameters, with the parts that its derivatives need.

    Attributes:
        deviance: -2 log of the restricted likelihood, up to a constant; see `deviance`.
        step: step from the linearisation to the most probable parameters.
        prior_precision: prior precision of each shared parameter and of each view's own.
        elimination: elimination of the views' own parameters from the posterior's information
            matrix.
        factor: Cholesky factor of the reduced information matrix.
    """

    deviance: Float[Array, ""]
    step: Step
    prior_precision: Step
    elimination: Elimination
    factor: Float[Array, "shared shared"]

    @property
    def shared_covariance(self) -> Float[Array, "shared shared"]:
        """The covariance of the shared parameters, with the views' own parameters marginalised."""
        return cho_solve((self.factor, False), jnp.eye(len(self.factor)))


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
    has_unknown_sigma = views.group_index >= 0
    weights = sigmas.prior_weights(views.group_index, views.known_weight)
    prior_precision = Step(
        weights.shared**2, jnp.where(views.per_view_free, weights.per_view**2, 0.0)
    )
    pixel_precision, matrix = sigmas.pixel**-2, views.matrix

    shared = pixel_precision * matrix.shared
    shared = shared + jnp.diag(prior_precision.shared + RELATIVE_RIDGE * jnp.diagonal(shared))
    # A fixed correction has a zero column; the one keeps its equation solvable.
    diagonal = jnp.where(views.per_view_free, prior_precision.per_view, 1.0)
    per_view = pixel_precision * matrix.per_view + jnp.eye(6)[None] * diagonal[:, None]
    information = BlockArrow(shared, pixel_precision * matrix.border, per_view)
    posterior_gradient = jax.tree.map(
        lambda g, w, off: pixel_precision * g + w * off,
        views.gradient,
        prior_precision,
        views.offset_from_prior,
    )
    solver = SchurCholesky()
    state = solver.init(information, {})
    step = jax.tree.map(jnp.negative, solver.compute(state, posterior_gradient, {})[0])

    prior_penalty = _total(
        jax.tree.map(lambda w, off: w * off**2, prior_precision, views.offset_from_prior)
    )
    gradient_step_product = _total(jax.tree.map(jnp.multiply, posterior_gradient, step))
    log_determinant = _log_determinant(state.factor) + _log_determinant(
        state.elimination.per_view_factor
    )
    prior_log_determinant = jnp.sum(
        jnp.where(has_unknown_sigma, jnp.log(prior_precision.shared), 0.0)
    )
    log_precision = jnp.broadcast_to(jnp.log(weights.per_view**2), views.per_view_free.shape)
    prior_log_determinant = prior_log_determinant + jnp.sum(
        jnp.where(views.per_view_free, log_precision, 0.0)
    )
    value = (
        -views.statistic_count * jnp.log(pixel_precision)
        + pixel_precision * views.residual_sum_of_squares
        + prior_penalty
        + gradient_step_product
    )
    return Marginalisation(
        value + log_determinant - prior_log_determinant,
        step,
        prior_precision,
        state.elimination,
        state.factor,
    )


def gradient(
    views: LinearisedViews, sigmas: StandardDeviations, marginal: Marginalisation
) -> StandardDeviations:
    """Compute the derivative of the deviance by every standard deviation.

    The derivative of the best step does not contribute, since the deviance is stationary there.
    """
    # dD / d log w_j = w_j E[(o_j + s_j)^2] - 1 for the precision w_j of a prior, where the
    # posterior expectation is (o_j + s_j)^2 + C_jj with C = A^-1.
    prior_precision, covariance = marginal.prior_precision, marginal.shared_covariance
    per_view_covariance = marginal.elimination.per_view_covariance(covariance)
    variance = Step(jnp.diagonal(covariance), jnp.diagonal(per_view_covariance, axis1=1, axis2=2))
    expected_square = jax.tree.map(
        lambda off, s, v: (off + s) ** 2 + v, views.offset_from_prior, marginal.step, variance
    )
    # Parameters without a prior of unknown standard deviation, and fixed ones, do not contribute.
    weighted_square = jax.tree.map(jnp.multiply, prior_precision, expected_square)
    shared = jnp.where(views.group_index >= 0, weighted_square.shared - 1.0, 0.0)
    per_view = jnp.where(views.per_view_free, weighted_square.per_view - 1.0, 0.0)

    # dD / d log p = p (R + 2 g.s + s.M s) + tr(p M C) - n, in the notation of `marginalise`, with
    # p M s = -p g - W (o + s) at the best step, and tr(p M C) = parameter_count - tr(W C), the
    # effective number of parameters that the pixels determine.
    pixel_precision = sigmas.pixel**-2
    parameter_count = jnp.sum(views.per_view_free.astype(float)) + len(marginal.factor)
    effective_parameters = parameter_count - _total(
        jax.tree.map(jnp.multiply, prior_precision, variance)
    )
    step_terms = jax.tree.map(
        lambda g, w, off, s: (pixel_precision * g - w * (off + s)) * s,
        views.gradient,
        prior_precision,
        views.offset_from_prior,
        marginal.step,
    )
    by_log_precision = (
        pixel_precision * views.residual_sum_of_squares
        + _total(step_terms)
        + effective_parameters
        - views.statistic_count
    )
    # Precision w = 1 / sigma^2: d log w / d sigma = -2 / sigma.
    return StandardDeviations(
        -2.0 * by_log_precision / sigmas.pixel,
        -2.0 * jnp.sum(per_view[:, :3]) / sigmas.translation,
        -2.0 * jnp.sum(per_view[:, 3:]) / sigmas.rotation,
        -2.0 * (group_indicator(views, len(sigmas.field)) @ shared) / sigmas.field,
    )


def _total(parts: Step) -> Float[Array, ""]:
    """Sum all components."""
    return jnp.sum(parts.shared) + jnp.sum(parts.per_view)


def _log_determinant(factor: Float[Array, "*batch n n"]) -> Float[Array, ""]:
    """Compute the log-determinant of matrices from their Cholesky factors."""
    return 2.0 * jnp.sum(jnp.log(jnp.diagonal(factor, axis1=-2, axis2=-1)))


def counts(views: LinearisedViews, groups: int) -> Float[Array, "kinds"]:
    """Count the random numbers of each kind, in the order of `StandardDeviations.vector`."""
    per_view_free = views.per_view_free.astype(float)
    field = jnp.sum(group_indicator(views, groups), axis=1)
    robot = jnp.stack([jnp.sum(per_view_free[:, :3]), jnp.sum(per_view_free[:, 3:])])
    return jnp.concatenate([views.statistic_count[None], robot, field])


def group_indicator(views: LinearisedViews, groups: int) -> Float[Array, "groups shared"]:
    """Return one where a shared parameter belongs to a group of unknown sigma, zero elsewhere."""
    return (views.group_index[None] == jnp.arange(groups)[:, None]).astype(float)
