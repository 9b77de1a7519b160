"""The restricted likelihood of the errors' sizes: of pixels, of reported poses, of their field.

A view's thousands of residuals say how white noise scatters within it, and next to nothing of what
shifts all of its points together. So the likelihood is that of view-level statistics: each view's
best free pose, and the camera of the fit with free poses, with the information that their pixels
give. Those scatter by an *effective* pixel sigma, not smaller than the white one; and around the
chain, by what the robot errs, smoothly and at random. Everything that is fitted without a prior is
integrated out with a flat one (restricted likelihood), so that few views do not look better than
they are.

With the chain linearised once, all of it is linear and Gaussian, and evaluated without another look
at the pixels.

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
"""Deviation, m or rad, at which an error of a robot counts as none.

Its inverse square times poses that are centimetres off must leave the deviance its digits.
"""

RIDGE = 1e-13
"""Share of its own information added to every shared parameter: what no view tells stays finite."""


class LinearisedViews(eqx.Module):
    """The observations' normal equations for one px of noise, and what the priors act on.

    Attributes:
        matrix: of the free shared parameters and of each view's own, without priors.
        gradient: of half the squared residuals.
        between: squared residuals there, px^2, beyond those that no pose and no camera removes.
        off_mean: how far the parameters are there from the means of their priors.
        known_weight: one over the deviation of the priors whose size is not asked for.
        group: number of the shared parameters' group of unknown size, -1 where there is none.
        own_free: which of each view's own six may move.
        count: view-level statistics: the camera's free numbers, and the views' own.
        white_sigma: of the noise within views, px.
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
        """The same views where the robot errs by another field, which has no coefficient yet.

        No pixel is looked at again: what a field does to a view, the view's own six can do.

        Args:
            twists: of the field, as its `by_coefficients` has them.
            group: of every coefficient.
            known: how many of the shared parameters are not of a field; they come first.
        """
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
        """What each size is at the least, in the order of `Sizes.numbers`."""
        return jnp.full(kinds, LEAST).at[0].set(self.white_sigma)


class Sizes(eqx.Module):
    """Standard deviations, all positive.

    Attributes:
        pixel: effective, px.
        translation: of reported poses, m.
        rotation: of reported poses, rad.
        field: of each group of coefficients; zero switches a group off.
    """

    pixel: Float[Array, ""]
    translation: Float[Array, ""]
    rotation: Float[Array, ""]
    field: Float[Array, "groups"]

    @property
    def numbers(self) -> Float[Array, "kinds"]:
        """In one vector: pixel, translation, rotation, field."""
        return jnp.concatenate(
            [jnp.stack([self.pixel, self.translation, self.rotation]), self.field]
        )

    @classmethod
    def of(cls, numbers: Float[Array, "kinds"]) -> "Sizes":
        """From one vector, as `numbers` is."""
        return cls(numbers[0], numbers[1], numbers[2], numbers[3:])

    def weights(self, group: Int[Array, "shared"], known: Float[Array, "shared"]) -> Step:
        """One over the deviation of every parameter's prior; one row for the views' own.

        Args:
            group: of each shared parameter, as in `LinearisedViews`.
            known: the weights of those in no group.
        """
        field = jnp.concatenate([self.field, jnp.ones(1)])[group]
        each = jnp.repeat(jnp.stack([self.translation, self.rotation]), 3)
        return Step(jnp.where(group >= 0, 1.0 / field, known), 1.0 / each[None])


@eqx.filter_custom_jvp
def deviance(views: LinearisedViews, sizes: Sizes) -> Float[Array, ""]:
    """Twice the negative logarithm of the restricted likelihood, up to a constant."""
    return integrate(views, sizes).deviance


@deviance.def_jvp
def _deviance_jvp(
    primals: tuple[LinearisedViews, Sizes], tangents: tuple[LinearisedViews, Sizes]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """By the sizes in closed form: half the work of a derivative through the factorisations."""
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
    """From the point of linearisation to the likeliest parameters, for errors of given sizes."""
    return integrate(views, sizes).step


class Integral(eqx.Module):
    """Everything integrated out: what is left, and what its derivatives are made of.

    Attributes:
        deviance: see there.
        step: to the likeliest parameters.
        precision: of the priors: of each shared parameter, of each view's own.
        elimination: of the views' own from the whole matrix.
        factor: Cholesky factor of what is left.
    """

    deviance: Float[Array, ""]
    step: Step
    precision: Step
    elimination: Elimination
    factor: Float[Array, "shared shared"]

    @property
    def shared_covariance(self) -> Float[Array, "shared shared"]:
        """Of the shared parameters, the views' own integrated out."""
        return cho_solve((self.factor, False), jnp.eye(len(self.factor)))


def integrate(views: LinearisedViews, sizes: Sizes) -> Integral:
    """Integrate everything that is fitted out, for errors of given sizes."""
    unknown = views.group >= 0
    weights = sizes.weights(views.group, views.known_weight)
    prior = Step(weights.shared**2, jnp.where(views.own_free, weights.corrections**2, 0.0))
    precision, matrix = sizes.pixel**-2, views.matrix

    shared = precision * matrix.shared
    shared = shared + jnp.diag(prior.shared + RIDGE * jnp.diagonal(shared))
    # A correction that is held has no column: a one keeps its equation solvable.
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
    """Derivative of the deviance by every size.

    By the precision of a parameter's prior it is its expected square less its prior's. What the
    step does can be left out: it is the best one.
    """
    prior, covariance = at.precision, at.shared_covariance
    own_covariance = at.elimination.own_covariance(covariance)
    variance = Step(jnp.diagonal(covariance), jnp.diagonal(own_covariance, axis1=1, axis2=2))
    square = jax.tree.map(lambda off, s, v: (off + s) ** 2 + v, views.off_mean, at.step, variance)
    # By the logarithm of a prior's precision; what has no prior, or does not move, does not count.
    pull = jax.tree.map(jnp.multiply, prior, square)
    shared = jnp.where(views.group >= 0, pull.shared - 1.0, 0.0)
    own = jnp.where(views.own_free, pull.corrections - 1.0, 0.0)

    # The observations' precision: p M s = -p g - w (off + s), where s is the best step.
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
    return Sizes(
        -2.0 * precision / sizes.pixel,
        -2.0 * jnp.sum(own[:, :3]) / sizes.translation,
        -2.0 * jnp.sum(own[:, 3:]) / sizes.rotation,
        -2.0 * (members(views, len(sizes.field)) @ shared) / sizes.field,
    )


def _total(parts: Step) -> Float[Array, ""]:
    return jnp.sum(parts.shared) + jnp.sum(parts.corrections)


def _log_diagonal(factor: Float[Array, "*batch n n"]) -> Float[Array, ""]:
    """Logarithm of the determinant of what Cholesky's factors are of."""
    return 2.0 * jnp.sum(jnp.log(jnp.diagonal(factor, axis1=-2, axis2=-1)))


def draws(views: LinearisedViews, groups: int) -> Float[Array, "kinds"]:
    """How many numbers each size is the deviation of, in the order of `Sizes.numbers`."""
    own = views.own_free.astype(float)
    field = jnp.sum(members(views, groups), axis=1)
    robot = jnp.stack([jnp.sum(own[:, :3]), jnp.sum(own[:, 3:])])
    return jnp.concatenate([views.count[None], robot, field])


def members(views: LinearisedViews, groups: int) -> Float[Array, "groups shared"]:
    """One where a shared parameter is of a group of unknown size, zero elsewhere."""
    return (views.group[None] == jnp.arange(groups)[:, None]).astype(float)
