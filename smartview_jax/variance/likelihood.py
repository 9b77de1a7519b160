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

LEAST = 1e-8
"""Standard deviation, m or rad, at which an error of the robot counts as zero.

It is not smaller because its inverse square, times the square of centimetres by which poses may be
wrong, must not cost the deviance its significant digits.
"""

RIDGE = 1e-13
"""Fraction of its own information added to that of every shared parameter.

The variance of a parameter that no view determines then stays finite.
"""


class LinearisedViews(eqx.Module):
    """The observations' normal equations for a pixel sigma of 1 px, and the layout of the priors.

    Attributes:
        matrix: normal equations of the free shared parameters and each view's own, without priors.
        gradient: gradient of half the sum of squared residuals.
        between: sum of squared residuals at the linearisation, px^2, minus that of the fit with
            free poses and a free camera.
        off_mean: difference of the parameters from their prior means at the linearisation.
        known_weight: one over the standard deviation of the priors with known standard deviations.
        group: index of the group of unknown standard deviation of each shared parameter, -1 for
            none.
        own_free: mask of the free parameters among each view's own six.
        count: number of statistics: free parameters of the camera, and of the views' own poses.
        white_sigma: standard deviation of the noise within views, px.
    """

    matrix: BlockArrow
    gradient: Step
    between: Float[Array, ""]
    off_mean: Step
    known_weight: Float[Array, "shared"]
    group: Array
    own_free: Bool[Array, "views 6"]
    count: Float[Array, ""]
    white_sigma: Float[Array, ""]

    def with_field(
        self, twists: Float[Array, "views 6 coefficients"], group: np.ndarray, known: int
    ) -> "LinearisedViews":
        """Return the same views with another robot error field, whose coefficients are still zero.

        The pixels are not needed again, since the effect of a field on a view is a twist, and each
        view's own six parameters are a twist as well.

        Args:
            twists: derivatives of the field, as its `by_coefficients` returns them.
            group: group index of every coefficient.
            known: number of shared parameters that do not belong to a field; they come first.
        """
        # With T_v the derivative of a view's correction by the coefficients, the new columns are
        # the view's own columns times T_v: sum_v B_v^T T_v, sum_v T_v^T D_v T_v, and D_v T_v in the
        # border.
        moves, count = -twists, len(group)
        matrix, border = self.matrix, self.matrix.border[:, :, :known]
        moved = matrix.own @ moves
        across = jnp.einsum("vki,vkj->ij", border, moves)
        among = jnp.einsum("vki,vkj->ij", moves, moved)
        slope = jnp.einsum("vki,vk->i", moves, self.gradient.corrections)
        off = self.off_mean
        return dataclasses.replace(
            self,
            matrix=BlockArrow(
                jnp.block([[matrix.shared[:known, :known], across], [across.T, among]]),
                jnp.concatenate([border, moved], axis=2),
                matrix.own,
            ),
            gradient=Step(
                jnp.concatenate([self.gradient.shared[:known], slope]), self.gradient.corrections
            ),
            off_mean=Step(jnp.pad(off.shared[:known], (0, count)), off.corrections),
            known_weight=jnp.pad(self.known_weight[:known], (0, count)),
            group=jnp.concatenate([self.group[:known], jnp.asarray(group)]),
        )

    def least(self, kinds: int) -> Float[Array, "kinds"]:
        """Return the lower bound of each standard deviation, in the order of `Sizes.numbers`."""
        return jnp.full(kinds, LEAST).at[0].set(self.white_sigma)


class Sizes(eqx.Module):
    """The standard deviations of all errors, all positive.

    Their squares are the variance components.

    Attributes:
        pixel: effective pixel sigma, px.
        translation: standard deviation of the translation of reported poses, m.
        rotation: standard deviation of the rotation of reported poses, rad.
        field: standard deviation of the coefficients in each group of the robot error field;
            `LEAST` disables a group.
    """

    pixel: Float[Array, ""]
    translation: Float[Array, ""]
    rotation: Float[Array, ""]
    field: Float[Array, "groups"]

    @property
    def numbers(self) -> Float[Array, "kinds"]:
        """The standard deviations as a vector: pixel, translation, rotation, field."""
        return jnp.concatenate(
            [jnp.stack([self.pixel, self.translation, self.rotation]), self.field]
        )

    @classmethod
    def of(cls, numbers: Float[Array, "kinds"]) -> "Sizes":
        """Create the sizes from a vector in the order of `numbers`."""
        return cls(numbers[0], numbers[1], numbers[2], numbers[3:])

    def weights(self, group: Int[Array, "shared"], known: Float[Array, "shared"]) -> Step:
        """Return one over the prior standard deviation of every parameter.

        The views' own have one common row.

        Args:
            group: group of each shared parameter, as in `LinearisedViews`.
            known: weights of the parameters that belong to no group.
        """
        # Index -1 (no group) reads the one at the end, which `where` then discards.
        field = jnp.concatenate([self.field, jnp.ones(1)])[group]
        each = jnp.repeat(jnp.stack([self.translation, self.rotation]), 3)
        return Step(jnp.where(group >= 0, 1.0 / field, known), 1.0 / each[None])


@eqx.filter_custom_jvp
def deviance(views: LinearisedViews, sizes: Sizes) -> Float[Array, ""]:
    """Compute the deviance, -2 log of the restricted likelihood, up to a constant."""
    return integrate(views, sizes).deviance


@deviance.def_jvp
def _deviance_jvp(
    primals: tuple[LinearisedViews, Sizes], tangents: tuple[LinearisedViews, Sizes]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Differentiate the deviance by the standard deviations in closed form.

    It takes half the work of differentiating through the factorisations.
    """
    if jax.tree.leaves(tangents[0]):
        return eqx.filter_jvp(lambda v, s: integrate(v, s).deviance, primals, tangents)
    views, sizes = primals
    at = integrate(views, sizes)
    by_size = jax.tree.leaves(slopes(views, sizes, at))
    moves = jax.tree.leaves(tangents[1], is_leaf=lambda x: x is None)
    parts = [
        jnp.sum(slope * move)
        for slope, move in zip(by_size, moves, strict=True)
        if move is not None
    ]
    return at.deviance, sum(parts, jnp.zeros(()))


def best_step(views: LinearisedViews, sizes: Sizes) -> Step:
    """Compute the step to the most probable parameters for errors of given sizes."""
    return integrate(views, sizes).step


class Integral(eqx.Module):
    """The result of marginalising all fitted parameters, with the parts that its derivatives need.

    Attributes:
        deviance: -2 log of the restricted likelihood, up to a constant; see `deviance`.
        step: step from the linearisation to the most probable parameters.
        precision: prior precision of each shared parameter and of each view's own.
        elimination: elimination of the views' own parameters from the posterior's information
            matrix.
        factor: Cholesky factor of the reduced information matrix.
    """

    deviance: Float[Array, ""]
    step: Step
    precision: Step
    elimination: Elimination
    factor: Float[Array, "shared shared"]

    @property
    def shared_covariance(self) -> Float[Array, "shared shared"]:
        """The covariance of the shared parameters, with the views' own parameters marginalised."""
        return cho_solve((self.factor, False), jnp.eye(len(self.factor)))


def integrate(views: LinearisedViews, sizes: Sizes) -> Integral:
    """Marginalise all fitted parameters for given error sizes."""
    # p = 1 / sigma^2, M and g the views' matrix and gradient for 1 px, W the prior precisions, o
    # the difference from the prior means. The information matrix of the posterior and its gradient
    # are A = p M + W and h = p g + W o, the best step is s = -A^-1 h, and
    #
    # deviance = -n log p + p between + o^T W o + h^T s + log det A - log det W
    #
    # with W in the last determinant only for priors of unknown size.
    unknown = views.group >= 0
    weights = sizes.weights(views.group, views.known_weight)
    prior = Step(weights.shared**2, jnp.where(views.own_free, weights.corrections**2, 0.0))
    precision, matrix = sizes.pixel**-2, views.matrix

    shared = precision * matrix.shared
    shared = shared + jnp.diag(prior.shared + RIDGE * jnp.diagonal(shared))
    # A held correction has a zero column; the one keeps its equation solvable.
    diagonal = jnp.where(views.own_free, prior.corrections, 1.0)
    own = precision * matrix.own + jnp.eye(6)[None] * diagonal[:, None]
    whole = BlockArrow(shared, precision * matrix.border, own)
    slope = jax.tree.map(
        lambda g, w, off: precision * g + w * off, views.gradient, prior, views.off_mean
    )
    solver = SchurCholesky()
    state = solver.init(whole, {})
    step = jax.tree.map(jnp.negative, solver.compute(state, slope, {})[0])

    penalty = _total(jax.tree.map(lambda w, off: w * off**2, prior, views.off_mean))
    gained = _total(jax.tree.map(jnp.multiply, slope, step))
    determinant = _log_diagonal(state.factor) + _log_diagonal(state.elimination.own_factor)
    priors = jnp.sum(jnp.where(unknown, jnp.log(prior.shared), 0.0))
    each = jnp.broadcast_to(jnp.log(weights.corrections**2), views.own_free.shape)
    priors = priors + jnp.sum(jnp.where(views.own_free, each, 0.0))
    value = -views.count * jnp.log(precision) + precision * views.between + penalty + gained
    return Integral(value + determinant - priors, step, prior, state.elimination, state.factor)


def slopes(views: LinearisedViews, sizes: Sizes, at: Integral) -> Sizes:
    """Compute the derivative of the deviance by every standard deviation.

    The derivative of the best step does not contribute, since the deviance is stationary there.
    """
    # dD / d log w_j = w_j E[(o_j + s_j)^2] - 1 for the precision w_j of a prior, where the
    # posterior expectation is (o_j + s_j)^2 + C_jj with C = A^-1.
    prior, covariance = at.precision, at.shared_covariance
    own_covariance = at.elimination.own_covariance(covariance)
    variance = Step(jnp.diagonal(covariance), jnp.diagonal(own_covariance, axis1=1, axis2=2))
    square = jax.tree.map(lambda off, s, v: (off + s) ** 2 + v, views.off_mean, at.step, variance)
    # Parameters without a prior of unknown size, and held ones, do not contribute.
    pull = jax.tree.map(jnp.multiply, prior, square)
    shared = jnp.where(views.group >= 0, pull.shared - 1.0, 0.0)
    own = jnp.where(views.own_free, pull.corrections - 1.0, 0.0)

    # dD / d log p = p (between + 2 g.s + s.M s) + tr(p M C) - n, with p M s = -p g - W (o + s) at
    # the best step, and tr(p M C) = (number of parameters) - tr(W C).
    pixel = sizes.pixel**-2
    moved = jnp.sum(views.own_free.astype(float)) + len(at.factor)
    freedom = moved - _total(jax.tree.map(jnp.multiply, prior, variance))
    along = jax.tree.map(
        lambda g, w, off, s: (pixel * g - w * (off + s)) * s,
        views.gradient,
        prior,
        views.off_mean,
        at.step,
    )
    precision = pixel * views.between + _total(along) + freedom - views.count
    # Precision w = 1 / size^2: d log w / d size = -2 / size.
    return Sizes(
        -2.0 * precision / sizes.pixel,
        -2.0 * jnp.sum(own[:, :3]) / sizes.translation,
        -2.0 * jnp.sum(own[:, 3:]) / sizes.rotation,
        -2.0 * (members(views, len(sizes.field)) @ shared) / sizes.field,
    )


def _total(parts: Step) -> Float[Array, ""]:
    """Sum all components."""
    return jnp.sum(parts.shared) + jnp.sum(parts.corrections)


def _log_diagonal(factor: Float[Array, "*batch n n"]) -> Float[Array, ""]:
    """Compute the log-determinant of matrices from their Cholesky factors."""
    return 2.0 * jnp.sum(jnp.log(jnp.diagonal(factor, axis1=-2, axis2=-1)))


def draws(views: LinearisedViews, groups: int) -> Float[Array, "kinds"]:
    """Count the random numbers behind each standard deviation, in the order of `Sizes.numbers`."""
    own = views.own_free.astype(float)
    field = jnp.sum(members(views, groups), axis=1)
    robot = jnp.stack([jnp.sum(own[:, :3]), jnp.sum(own[:, 3:])])
    return jnp.concatenate([views.count[None], robot, field])


def members(views: LinearisedViews, groups: int) -> Float[Array, "groups shared"]:
    """Return one where a shared parameter belongs to a group of unknown size, zero elsewhere."""
    return (views.group[None] == jnp.arange(groups)[:, None]).astype(float)
