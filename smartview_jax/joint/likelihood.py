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

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from .parameters import Step
from .schur import BlockArrow, SchurCholesky

LEAST = 1e-9
"""Deviation, m or rad, at which an error of a robot counts as none."""

WIDEST = 15.0
"""Logarithms of deviations are kept within this of where the search began."""

RIDGE = 1e-13
"""Share of its own information added to every shared parameter: what no view tells stays finite."""

TOLERANCE = 1e-3
"""Of the logarithms of sizes, and of the deviance."""

STEPS = 200
"""Of the search, at most."""


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

    def weights(self, group: Int[Array, "shared"], known: Float[Array, "shared"]) -> Step:
        """One over the deviation of every parameter's prior; one row for the views' own.

        Args:
            group: of each shared parameter, as in `LinearisedViews`.
            known: the weights of those in no group.
        """
        field = jnp.concatenate([self.field, jnp.ones(1)])[group]
        each = jnp.repeat(jnp.stack([self.translation, self.rotation]), 3)
        return Step(jnp.where(group >= 0, 1.0 / field, known), 1.0 / each[None])


def deviance(views: LinearisedViews, sizes: Sizes) -> Float[Array, ""]:
    """Twice the negative logarithm of the restricted likelihood, up to a constant."""
    return _integrated(views, sizes)[0]


def best_step(views: LinearisedViews, sizes: Sizes) -> Step:
    """From the point of linearisation to the likeliest parameters, for errors of given sizes."""
    return _integrated(views, sizes)[1]


def _integrated(views: LinearisedViews, sizes: Sizes) -> tuple[Float[Array, ""], Step]:
    unknown = views.group >= 0
    weights = sizes.weights(views.group, views.known_weight)
    weight, each = weights.shared, weights.corrections
    own_weight = jnp.where(views.own_free, each, 0.0)
    precision, matrix = sizes.pixel**-2, views.matrix

    shared = precision * matrix.shared
    shared = shared + jnp.diag(weight**2 + RIDGE * jnp.diagonal(shared))
    # A correction that is held has no column: a one keeps its equation solvable.
    diagonal = jnp.where(views.own_free, own_weight**2, 1.0)
    own = precision * matrix.own + jnp.eye(6)[None] * diagonal[:, None]
    whole = BlockArrow(shared, precision * matrix.border, own)
    off = views.off_mean
    slope = Step(
        precision * views.gradient.shared + weight**2 * off.shared,
        precision * views.gradient.corrections + own_weight**2 * off.corrections,
    )
    solver = SchurCholesky()
    state = solver.init(whole, {})
    step = jax.tree.map(jnp.negative, solver.compute(state, slope, {})[0])

    gained = jnp.sum(slope.shared * step.shared)
    gained = gained + jnp.sum(slope.corrections * step.corrections)
    penalty = jnp.sum((weight * off.shared) ** 2) + jnp.sum((own_weight * off.corrections) ** 2)
    determinant = _log_diagonal(state.factor) + _log_diagonal(state.elimination.own_factor)
    priors = jnp.sum(jnp.where(unknown, jnp.log(weight**2), 0.0))
    priors = priors + jnp.sum(jnp.where(views.own_free, 2.0 * jnp.log(each), 0.0))
    value = -views.count * jnp.log(precision) + precision * views.between + penalty + gained
    return value + determinant - priors, step


def _log_diagonal(factor: Float[Array, "*batch n n"]) -> Float[Array, ""]:
    """Logarithm of the determinant of what Cholesky's factors are of."""
    return 2.0 * jnp.sum(jnp.log(jnp.diagonal(factor, axis1=-2, axis2=-1)))


def likeliest(
    views: LinearisedViews, start: Sizes, active: Bool[Array, "robot"]
) -> tuple[Sizes, Float[Array, ""]]:
    """The sizes of errors that make the views' statistics likeliest.

    Args:
        views: linearised.
        start: where the search begins.
        active: which errors of the robot may have a size: of translation, of rotation, of each
            group of the field; the others have none.

    Returns:
        The sizes, and the deviance there.
    """
    begin = jnp.log(start.numbers)

    def sizes(x: Float[Array, "kinds"]) -> Sizes:
        free = jnp.exp(begin + WIDEST * jnp.tanh(x / WIDEST))
        pixel = jnp.hypot(views.white_sigma, free[0])
        robot = jnp.where(active, jnp.hypot(LEAST, free[1:]), LEAST)
        return Sizes(pixel, robot[0], robot[1], robot[2:])

    found = optx.minimise(
        lambda x, _: deviance(views, sizes(x)),
        optx.BFGS(rtol=1e-6, atol=TOLERANCE),
        jnp.zeros_like(begin),
        max_steps=STEPS,
        throw=False,
    )
    best = sizes(found.value)
    return best, deviance(views, best)
