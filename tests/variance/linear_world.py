"""A linear world: what views would tell of a chain that is linear, and the errors in it.

Small enough for the textbook's formulas on dense matrices. Everything is NumPy, as the library's
own searches are; tests of JAX programs convert it first.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from smartview_jax.engine.parameters import Step
from smartview_jax.engine.schur import BlockArrow
from smartview_jax.variance.linearised_views import LinearisedViews
from smartview_jax.variance.standard_deviations import StandardDeviations

CAMERA, MOUNT, FIELD, VIEWS = 3, 4, (2, 3), 30
SHARED = CAMERA + MOUNT + sum(FIELD)


class LinearWorld(NamedTuple):
    """Information of every view's statistics, how these come about, and what all draws share.

    The root of the noise's covariance (per squared size), and `design.T @ information @ design`.
    """

    information: np.ndarray
    design: np.ndarray
    noise_root: np.ndarray
    normal_matrix: BlockArrow


def linear_world():
    """Observations of the camera's numbers and of each view's six."""
    rng = np.random.default_rng(0)
    size = CAMERA + 6 * VIEWS
    # An observed value of the camera's numbers and of each view's six, with correlated errors.
    roots = [rng.normal(size=(9, 6 + CAMERA)) for _ in range(VIEWS)]
    information = np.zeros((size, size))
    for k, root in enumerate(roots):
        where = np.r_[:CAMERA, CAMERA + 6 * k : CAMERA + 6 * k + 6]
        information[np.ix_(where, where)] += root.T @ root
    design = np.zeros((size, SHARED + 6 * VIEWS))
    design[:CAMERA, :CAMERA] = np.eye(CAMERA)
    design[CAMERA:, CAMERA:SHARED] = rng.normal(size=(6 * VIEWS, SHARED - CAMERA))
    design[CAMERA:, SHARED:] = np.eye(6 * VIEWS)
    noise_root = np.linalg.cholesky(np.linalg.inv(information))
    normal_matrix = design.T @ information @ design
    off = normal_matrix[SHARED:, SHARED:].reshape(VIEWS, 6, VIEWS, 6).copy()
    own = off[range(VIEWS), :, range(VIEWS)]
    off[range(VIEWS), :, range(VIEWS)] = 0.0
    assert np.abs(off).max() < 1e-12
    border = normal_matrix[SHARED:, :SHARED].reshape(VIEWS, 6, SHARED)
    blocks = BlockArrow(*map(jnp.asarray, (normal_matrix[:SHARED, :SHARED], border, own)))
    return LinearWorld(information, design, noise_root, jax.tree.map(np.asarray, blocks))


TRUTH = StandardDeviations.from_vector(np.array([0.7, 0.4, 0.2, 0.5, 0.3]))
GROUP = np.repeat([-1, 0, 1], [CAMERA + MOUNT, *FIELD])


def drawn(world, seed, held=None):
    """Statistics drawn from the model; the views' own numbers that are held are nothing."""
    rng = np.random.default_rng(seed)
    effects = 2.0 * rng.normal(size=SHARED)
    for k, deviation in enumerate(np.asarray(TRUTH.field)):
        effects[k == GROUP] = deviation * rng.normal(size=FIELD[k])
    each = np.repeat([TRUTH.translation, TRUTH.rotation], 3)
    own = (each * rng.normal(size=(VIEWS, 6))).ravel()
    own = own if held is None else np.where(held, 0.0, own)
    noise = world.noise_root @ rng.normal(size=len(world.noise_root))
    return world.design @ np.concatenate([effects, own]) + float(TRUTH.pixel) * noise


def linearised(world, observed, at=None):
    """What the library is given: normal equations at a point of all parameters."""
    information, design, _, matrix = world
    at = np.zeros(design.shape[1]) if at is None else at
    residual = observed - design @ at
    slope = -design.T @ (information @ residual)
    return LinearisedViews(
        matrix=matrix,
        gradient=Step(slope[:SHARED], slope[SHARED:].reshape(VIEWS, 6)),
        residual_sum_of_squares=residual @ information @ residual,
        offset_from_prior=Step(at[:SHARED], at[SHARED:].reshape(VIEWS, 6)),
        known_weight=np.zeros(SHARED),
        group_index=GROUP,
        per_view_free=np.ones((VIEWS, 6), dtype=bool),
        statistic_count=np.asarray(float(len(observed))),
        white_sigma=np.asarray(1e-6),
    )


GROUP_FIXED = np.concatenate([GROUP < 0, np.zeros(6 * VIEWS, dtype=bool)])

OTHERS = (
    StandardDeviations.from_vector(np.array([0.3, 0.9, 0.05, 2.0, 0.01])),
    StandardDeviations.from_vector(np.array([2.0, 0.1, 0.6, 0.1, 1.0])),
)


def moved(sizes, k, share):
    """One of the sizes larger by a share of it."""
    numbers = np.array(sizes.vector)
    numbers[k] *= 1.0 + share
    return StandardDeviations.from_vector(numbers)


def with_held(views, free):
    """What `JointProblem` makes of corrections that are held: no columns."""
    own = np.where(free[..., None] & free[:, None], views.matrix.per_view, 0.0)
    border = np.where(free[..., None], views.matrix.border, 0.0)
    gradient = np.where(free, views.gradient.per_view, 0.0)
    return eqx.tree_at(
        lambda v: (v.matrix.per_view, v.matrix.border, v.gradient.per_view, v.per_view_free),
        views,
        (own, border, gradient, free),
    )


def some_held():
    """Whether each of the views' own numbers is free; three in ten are held."""
    return np.random.default_rng(9).random((VIEWS, 6)) < 0.7
