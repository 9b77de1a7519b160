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
from typing import NamedTuple, TypeAlias

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

AnyScalars: TypeAlias = Float[AnyArray, "*searches"] | float
"""A number, or one for each of several searches."""


class LinearisedViews(NamedTuple):
    """The observations' normal equations for a pixel sigma of 1 px, and the layout of the priors.

    Several searches that hold different parameters have views in common: see
    `with_held_in_searches`.

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
    residual_sum_of_squares: AnyScalars
    offset_from_prior: Step
    known_weight: Float[AnyArray, "*searches shared"]
    group_index: Int[AnyArray, "*searches shared"]
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

    def with_held_in_searches(self, held: Bool[np.ndarray, "searches shared"]) -> "LinearisedViews":
        """Return the views with other shared parameters held in each of several searches.

        Arrays that differ between the searches get these as their first axis. Parameters that all
        searches hold are left out. One that a single search holds stays, known by its prior
        alone, so that it contributes nothing: no information, no offset, and a prior with a known
        standard deviation of one.

        Args:
            held: mask of the parameters to hold at their prior means.
        """
        is_unused = np.asarray(held.all(axis=0))
        views, held = self.with_held(is_unused), held[:, ~is_unused]
        if not held.any():
            return views
        matrix, gradient = views.matrix, views.gradient
        # As in `with_held`, with d = 0 for the parameters that are not held.
        change = np.where(held, -views.offset_from_prior.shared, 0.0)
        gradient_change = change @ matrix.shared
        border_change = change @ rows_of_views(matrix.border).T
        growth = np.vecdot(2.0 * gradient.shared + gradient_change, change)
        is_off = held[:, :, None] | held[:, None, :]
        return views._replace(
            matrix=with_fields(
                matrix,
                shared=np.where(is_off, 0.0, matrix.shared),
                border=np.where(held[:, None, None], 0.0, matrix.border),
            ),
            gradient=Step(
                np.where(held, 0.0, gradient.shared + gradient_change),  # pyright: ignore[reportArgumentType]
                gradient.per_view + border_change.reshape(-1, *gradient.per_view.shape),
            ),
            residual_sum_of_squares=views.residual_sum_of_squares + growth,
            offset_from_prior=Step(
                np.where(held, 0.0, views.offset_from_prior.shared),  # pyright: ignore[reportArgumentType]
                views.offset_from_prior.per_view,
            ),
            known_weight=np.where(held, 1.0, views.known_weight),
            group_index=np.where(held, -1, views.group_index),
        )

    def about_common(
        self,
        coefficients: Int[np.ndarray, "coefficients"],
        mean: Float[np.ndarray, "coefficients"],
        root: Float[np.ndarray, "coefficients uncertain"],
    ) -> "LinearisedViews":
        """Return the views with prior means of some parameters, known to a covariance `R R^T`.

        The parameters are mean + R u + e. Those with the given indices become e, and the u, with a
        known prior of variance one, come last.

        Args:
            coefficients: indices of the parameters.
            mean: their prior means.
            root: a matrix R.
        """
        matrix, gradient, count = self.matrix, self.gradient, root.shape[1]
        offset = np.array(self.offset_from_prior.shared)
        by_common = np.zeros((len(offset), count))
        by_common[coefficients] = root
        whole = np.concatenate([np.eye(len(offset)), by_common], axis=1)
        # The linearisation stays where it is, with u = 0.
        offset[coefficients] -= mean
        return self._replace(
            matrix=with_fields(
                matrix, shared=whole.T @ matrix.shared @ whole, border=matrix.border @ whole
            ),
            gradient=Step(gradient.shared @ whole, gradient.per_view),
            offset_from_prior=Step(
                np.append(offset, np.zeros(count)),  # pyright: ignore[reportArgumentType]
                self.offset_from_prior.per_view,
            ),
            known_weight=np.append(self.known_weight, np.ones(count)),
            group_index=np.append(self.group_index, np.full(count, -1)),
        )

    def without_common(
        self,
        coefficients: Int[np.ndarray, "coefficients"],
        common: Int[np.ndarray, "uncertain"],
        mean: Float[np.ndarray, "coefficients"],
        root: Float[np.ndarray, "coefficients uncertain"],
    ) -> "LinearisedViews":
        """Return the views with the whole parameters about zero; the reverse of `about_common`.

        Args:
            coefficients, mean, root: as of `about_common`.
            common: indices of the u.
        """
        offset = np.array(self.offset_from_prior.shared)
        offset[coefficients] += mean + root @ offset[common]
        kept = np.setdiff1d(np.arange(len(offset)), common)
        matrix, index = self.matrix, self.group_index[kept]
        removed = self.group_index[common][:1]
        return self._replace(
            matrix=with_fields(
                matrix, shared=matrix.shared[np.ix_(kept, kept)], border=matrix.border[:, :, kept]
            ),
            gradient=Step(self.gradient.shared[kept], self.gradient.per_view),
            offset_from_prior=Step(
                offset[kept],  # pyright: ignore[reportArgumentType]
                self.offset_from_prior.per_view,
            ),
            known_weight=self.known_weight[kept],
            group_index=index - (index > removed) if (removed >= 0).any() else index,
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

    groups: Float[AnyArray, "*searches groups shared"]
    counts: Float[AnyArray, "*searches kinds"]


class StandardDeviations(NamedTuple):
    """The standard deviations of all errors, all positive.

    Their squares are the variance components. Of several searches they are arrays whose first axis
    counts the searches.

    Attributes:
        pixel: effective pixel sigma, px.
        translation: standard deviation of the translation of reported poses, m.
        rotation: standard deviation of the rotation of reported poses, rad.
        field: standard deviation of the coefficients in each group of the robot error field;
            `ROBOT_SIGMA_FLOOR` disables a group.
    """

    pixel: AnyScalars
    translation: AnyScalars
    rotation: AnyScalars
    field: Float[AnyArray, "*searches groups"]

    @property
    def vector(self) -> Float[AnyArray, "*searches kinds"]:
        """The standard deviations as a vector: pixel, translation, rotation, field."""
        xp = array_namespace(*self)
        pixel_and_pose = xp.array([self.pixel, self.translation, self.rotation])
        return xp.concatenate([pixel_and_pose.T, self.field], axis=-1)

    @classmethod
    def from_vector(cls, vector: Float[AnyArray, "*searches kinds"]) -> "StandardDeviations":
        """Create the standard deviations from a vector in the order of `vector`."""
        pixel, translation, rotation = vector.T[:3]
        return cls(pixel, translation, rotation, vector[..., 3:])

    def prior_weights(
        self,
        group_index: Int[AnyArray, "*searches shared"],
        known_weight: Float[AnyArray, "*searches shared"],
    ) -> Step:
        """Return one over the prior standard deviation of every parameter.

        The views' own have one common row.

        Args:
            group_index: group of each shared parameter, as in `LinearisedViews`.
            known_weight: weights of the parameters that belong to no group.
        """
        xp = array_namespace(*self)
        # Index -1 (no group) reads the last one, which `where` then discards.
        field = xp.concatenate([self.field, xp.ones((*self.field.shape[:-1], 1))], axis=-1)
        field = (
            field[..., group_index]
            if group_index.ndim == 1
            else xp.take_along_axis(field, group_index, -1)
        )
        translation, rotation = (xp.asarray(x)[..., None] for x in self[1:3])
        pose_sigmas = translation * IS_POSE_KIND[0] + rotation * IS_POSE_KIND[1]
        weights = xp.where(group_index >= 0, 1.0 / field, known_weight)
        return Step(weights, 1.0 / pose_sigmas[..., None, :])


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
    has_unknown_sigma = views.group_index >= 0
    matrix, offset = views.matrix, views.offset_from_prior
    weights = sigmas.prior_weights(views.group_index, views.known_weight)
    prior_precision = Step(
        weights.shared**2, xp.where(views.per_view_free, weights.per_view**2, 0.0)
    )
    pixel_precision = xp.asarray(sigmas.pixel) ** -2.0
    of_vectors, of_matrices, of_blocks = (
        pixel_precision.reshape(*pixel_precision.shape, *(1,) * axes) for axes in (1, 2, 3)
    )

    shared = of_matrices * matrix.shared
    ridge = RELATIVE_RIDGE * _diagonal(shared)
    shared = with_added_diagonal(shared, prior_precision.shared + ridge)
    # A fixed correction has a zero column; 1 on the diagonal keeps the equations solvable.
    diagonal = xp.where(views.per_view_free, prior_precision.per_view, 1.0)
    per_view = with_added_diagonal(of_blocks * matrix.per_view, diagonal)
    shared_gradient = of_vectors * views.gradient.shared + prior_precision.shared * offset.shared
    per_view_gradient = (
        of_matrices * views.gradient.per_view + prior_precision.per_view * offset.per_view
    )

    # With D_v a view's own block, B_v its border, F_v D_v F_v^T = 1 and E_v = F_v B_v, the Schur
    # complement is S = A_shared - sum_v E_v^T E_v; with F S F^T = 1, the whitened gradients are
    # c_v = F_v h_v and c = F (h_shared - sum_v E_v^T c_v), and h^T A^-1 h = |c|^2 + sum_v |c_v|^2.
    per_view_whitening = inverse_cholesky_factor(per_view)
    whitened_border = (of_blocks * per_view_whitening) @ matrix.border
    border_rows = rows_of_views(whitened_border)
    border_columns = border_rows.swapaxes(-1, -2)
    shared_whitening = inverse_cholesky_factor(shared - border_columns @ border_rows)
    per_view_rhs = _times_vectors(per_view_whitening, per_view_gradient)
    all_rhs = per_view_rhs.reshape(border_rows.shape[:-1])
    shared_rhs = _times_vectors(
        shared_whitening, shared_gradient - _times_vectors(border_columns, all_rhs)
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
    log_shared_precision = xp.log(xp.where(has_unknown_sigma, prior_precision.shared, 1.0))
    log_per_view_precision = xp.where(views.per_view_free, xp.log(weights.per_view**2), 0.0)
    log_prior_determinant = log_shared_precision.sum(axis=-1) + log_per_view_precision.sum(
        axis=(-2, -1)
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


def rows_of_views(
    blocks: Float[AnyArray, "*searches views own columns"],
) -> Float[AnyArray, "*searches rows columns"]:
    """Return the blocks of all views one below the other, as a single matrix."""
    *searches, views, size, columns = blocks.shape
    return blocks.reshape(*searches, views * size, columns)


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


def kinds_of(views: LinearisedViews, groups: int) -> Kinds:
    """Return the kind of each random number of the views, given the number of groups."""
    xp = array_namespace(views.group_index)
    index = views.group_index
    indicator = (index[..., None, :] == xp.arange(groups)[:, None]).astype(float)
    robot = xp.sum(views.per_view_free.reshape(-1, 2, 3), axis=(0, 2), dtype=float)
    statistics = xp.reshape(xp.asarray(views.statistic_count), 1)
    of_all = xp.broadcast_to(xp.concatenate([statistics, robot]), (*index.shape[:-1], 3))
    return Kinds(indicator, xp.concatenate([of_all, xp.sum(indicator, axis=-1)], axis=-1))
