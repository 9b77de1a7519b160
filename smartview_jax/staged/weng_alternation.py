"""Weng's second step in one view: pose and pinhole numbers, then distortion, in turn.

The half-step for the pose and the pinhole numbers is a damped Gauss-Newton step on Eq. 8, read as
measured minus projected pixels (as printed it mixes pixels with normalised units). The half-step
for k1 is linear least squares: the paper's lens maps distorted to ideal coordinates, so that
`ideal - distorted = k1 distorted r^2`. Either is kept only if it lowers Eq. 8.

Taking turns protects the first steps, in which a wrong k1 would bend the pose; near the end it
only crawls along the valley in which k1 and alpha make up for each other. Where a turn gains no
more than a thousandth, all are freed at once and the same cost is taken to its minimum.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..geometry import transform_points
from .weng_start import Intrinsics

_TURNS = 60
_ROUNDS = 8
_FAR = 1e4
"""Residual of a point that cannot be projected, px."""


class Found(NamedTuple):
    """What came out of one view; `alpha_std` is relative, infinite where alpha was held."""

    intrinsics: Intrinsics
    camera_from_world: SE3
    rms: Array
    alpha_std: Array
    used: Array


class _State(NamedTuple):
    numbers: Array  # log alpha_u, log (alpha_v / alpha_u), u0, v0, k1
    pose: SE3


class _Progress(NamedTuple):
    state: _State
    cost: Array
    damping: Array
    together: Array
    done: Array
    turn: Array


def alternate(
    points: Float[Array, "points 3"],
    pixels: Float[Array, "points 2"],
    visible: Bool[Array, "points"],
    intrinsics: Intrinsics,
    pose: SE3,
    free: Bool[Array, "5"],
) -> Found:
    """One view from one start, repeated without the points that stand out until none does.

    Args:
        points, pixels, visible: of one view; pixels finite everywhere.
        intrinsics, pose: the start.
        free: which of alpha (both), alpha_v / alpha_u, u0, v0 and k1 are estimated.
    """
    alpha_u, alpha_v, u0, v0, k1 = intrinsics
    ratio = jnp.where(free[1], jnp.log(alpha_v / alpha_u), 0.0)
    state = _State(jnp.stack([jnp.log(alpha_u), ratio, u0, v0, k1]), pose)

    def trim(carry):
        """Gross outliers give way in a few rounds, the largest first."""
        state, used, _, rounds = carry
        state = _minimise(state, points, pixels, used, free)
        size = jnp.linalg.norm(_residuals(state, points, pixels, visible), axis=-1)
        scale = jnp.nanmedian(jnp.where(visible, size, jnp.nan))
        kept = visible & (size <= 5.0 * scale + 1e-6)
        return state, kept, jnp.any(kept != used), rounds + 1

    state, used, _, _ = jax.lax.while_loop(
        lambda carry: carry[2] & (carry[3] < _ROUNDS),
        trim,
        (state, visible, jnp.any(visible), 0),
    )
    return _summary(state, points, pixels, used, free)


def _summary(state: _State, points: Array, pixels: Array, used: Array, free: Array) -> Found:
    gram = _normal_equations(state, points, pixels, used, free)
    count = jnp.sum(used).astype(float)
    unknowns = jnp.sum(_free11(free)).astype(float)
    variance = gram[-1, -1] / jnp.maximum(2.0 * count - unknowns, 1.0)
    # A few exact points must not pass for a determined alpha: no detector is better than this.
    variance = jnp.maximum(variance, 0.05**2)
    scale = jnp.sqrt(_where_positive(jnp.diag(gram)[:-1]))
    information = gram[:-1, :-1] / scale[:, None] / scale[None]
    information = information + jnp.diag(jnp.where(_free11(free), 1e-14, 1.0))
    share = jnp.linalg.inv(information)[0, 0] / scale[0] ** 2
    determined = free[0] & jnp.isfinite(share) & (share > 0.0)
    alpha_std = jnp.where(
        determined, jnp.sqrt(jnp.where(determined, share * variance, 1.0)), jnp.inf
    )
    log_alpha, log_ratio, u0, v0, k1 = state.numbers
    found = Intrinsics(jnp.exp(log_alpha), jnp.exp(log_alpha + log_ratio), u0, v0, k1)
    rms = jnp.sqrt(gram[-1, -1] / jnp.maximum(count, 1.0))
    return Found(found, state.pose, rms, alpha_std, used)


def _minimise(state: _State, points: Array, pixels: Array, used: Array, free: Array) -> _State:
    """The alternation, and its finish with all unknowns together."""

    def cost(state):
        return jnp.sum(_residuals(state, points, pixels, used) ** 2)

    def turn(progress: _Progress) -> _Progress:
        state, before, damping, together, _, turns = progress
        gram = _normal_equations(state, points, pixels, used, free.at[4].set(free[4] & together))
        trial = _moved(state, _damped_step(gram, damping))
        after = cost(trial)
        better = after < before
        state, after = _choose(better, (trial, after), (state, before))
        state, after = jax.lax.cond(
            free[4] & ~together,
            lambda: _radial_half_step(state, after, cost, points, pixels, used),
            lambda: (state, after),
        )
        gain = before - after
        # A step that was refused says nothing about the end; the damping does.
        stuck = damping > 1e6
        settled = (better & (gain <= 1e-12 * before)) | stuck | (after <= 1e-18)
        crawling = (better & (gain <= 1e-3 * before)) | stuck | (turns >= _TURNS // 3)
        damping = jnp.maximum(jnp.where(better, damping * 0.1, damping * 10.0), 1e-12)
        damping = jnp.where(crawling & ~together, 1e-3, damping)
        return _Progress(state, after, damping, together | crawling, together & settled, turns + 1)

    start = _Progress(
        state,
        cost(state),
        jnp.asarray(1e-3),
        jnp.asarray(False),
        ~jnp.any(used),
        jnp.asarray(0),
    )
    return jax.lax.while_loop(lambda p: ~p.done & (p.turn < _TURNS), turn, start).state


def _radial_half_step(state, before, cost, points, pixels, used):
    """k1 by linear least squares: `ideal - distorted = k1 distorted r^2`."""
    log_alpha, log_ratio, u0, v0, _ = state.numbers
    alpha = jnp.exp(jnp.stack([log_alpha, log_alpha + log_ratio]))
    distorted = (pixels - jnp.stack([u0, v0])[None]) / alpha[None]
    p = transform_points(state.pose, points)
    weight = (used & (p[:, 2] > 0.0))[:, None].astype(float) * alpha[None]
    ideal = p[:, :2] / jnp.where(p[:, 2:] > 0.0, p[:, 2:], 1.0)
    column = distorted * jnp.sum(distorted**2, axis=1, keepdims=True) * weight
    k1 = jnp.sum(column * (ideal - distorted) * weight) / (jnp.sum(column**2) + 1e-300)
    trial = state._replace(numbers=state.numbers.at[4].set(k1))
    after = cost(trial)
    return _choose(after < before, (trial, after), (state, before))


def _choose(condition, one, other):
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), one, other)


def _project(numbers: Array, points: Array) -> tuple[Array, Array]:
    """Pixels of camera-frame points, zero and flagged where there are none."""
    log_alpha, log_ratio, u0, v0, k1 = numbers
    found = Intrinsics(jnp.exp(log_alpha), jnp.exp(log_alpha + log_ratio), u0, v0, k1)
    pixels, valid = found.camera((1, 1)).project(points)
    return jnp.where(valid[..., None], pixels, 0.0), valid


def _residuals(state: _State, points: Array, pixels: Array, used: Array) -> Array:
    predicted, valid = _project(state.numbers, transform_points(state.pose, points))
    residual = jnp.where(valid[:, None], pixels - predicted, _FAR)
    return jnp.where(used[:, None], residual, 0.0)


def _moved(state: _State, step: Array) -> _State:
    return _State(state.numbers + step[:5], SE3.exp(step[5:]) @ state.pose)


def _free11(free: Array) -> Array:
    return jnp.concatenate([free, jnp.ones(6, dtype=bool)])


def _normal_equations(
    state: _State, points: Array, pixels: Array, used: Array, free: Array
) -> Array:
    """`[J r]' [J r]`, 12 x 12, with J the derivative of the prediction and r the residual."""
    p = transform_points(state.pose, points)
    J_numbers, J_point = jax.vmap(
        jax.jacfwd(lambda n, q: _project(n, q)[0], argnums=(0, 1)), in_axes=(None, 0)
    )(state.numbers, p)
    # A twist (v, w) acting from the left moves a point of the camera frame by v + w x p.
    turned = jnp.cross(p[:, None], J_point)
    J = jnp.concatenate([J_numbers, J_point, turned], axis=-1)
    J = jnp.where(used[:, None, None], J, 0.0) * _free11(free)[None, None].astype(float)
    rows = jnp.concatenate([J, _residuals(state, points, pixels, used)[..., None]], axis=-1)
    rows = rows.reshape(-1, rows.shape[-1])
    return rows.T @ rows


def _damped_step(gram: Array, damping: Array) -> Array:
    """Levenberg-Marquardt's step, each unknown in its own scale."""
    scale = jnp.sqrt(_where_positive(jnp.diag(gram)[:-1]))
    matrix = gram[:-1, :-1] / scale[:, None] / scale[None]
    # Unknowns that are held have zero rows; a one on the diagonal leaves them where they are.
    matrix = matrix + jnp.diag(jnp.where(jnp.diag(matrix) > 0.0, damping, 1.0))
    return jnp.linalg.solve(matrix, gram[:-1, -1] / scale) / scale


def _where_positive(values: Array) -> Array:
    return jnp.where(values > 0.0, values, 1.0)
