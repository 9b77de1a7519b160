"""Fit one view by Weng's second step: pose and pinhole intrinsics alternating with distortion.

Both half-steps minimise the objective of Step 1, Eq. 8: the sum of squared residuals, measured
minus projected pixel. As printed, Eq. 8 contains `u - u~` and mixes pixels with normalised units;
that is a misprint, and the pixel residual is what is meant.

- Pose and pinhole intrinsics: a Levenberg-Marquardt step on Eq. 8.
- k1: linear least squares. The paper's lens (Eq. 3) maps distorted to ideal coordinates, so that
  `ideal - distorted = k1 distorted r^2`.

Either half-step is kept only if it lowers Eq. 8.

Alternating protects the first iterations, in which a wrong k1 would distort the pose. Near the
optimum it converges slowly, because k1 and alpha compensate each other. As soon as one iteration
lowers the cost by no more than a thousandth (or after a third of the iterations), all unknowns are
freed together and the same cost is minimised by Levenberg-Marquardt alone.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..cameras import Radial
from ..geometry import transformed_coordinates
from ..runtime.array_namespace import where_tree
from .weng_start import Intrinsics

_MAX_ITERATIONS = 60
"""Maximum number of iterations of one minimisation."""
_HOPELESS_RMS_RATIO = 3.0
"""Multiple of the RMS error from another start at which a minimisation is given up.

Of the two poses of a flat target the wrong one has a long valley in which the cost falls by a few
hundredths for as long as it is given: three quarters of the time of Step 1."""
_MAX_TRIMMING_ROUNDS = 8
"""Maximum number of repeated fits while gross errors are being rejected."""
_UNPROJECTABLE_RESIDUAL = 1e4
"""Residual assigned to a point that cannot be projected, px."""


class ViewFit(NamedTuple):
    """The result of one view; `alpha_relative_std` is infinite where alpha was held."""

    intrinsics: Intrinsics
    camera_from_world: SE3
    rms: Array
    alpha_relative_std: Array
    inliers: Array


class _State(NamedTuple):
    """The unknowns of one view."""

    camera_parameters: Array  # log alpha_u, log (alpha_v / alpha_u), u0, v0, k1
    pose: SE3


class _LoopState(NamedTuple):
    """The loop state of `_minimise`; `joint` says whether k1 is in the joint step already."""

    state: _State
    cost: Array
    damping: Array
    joint: Array
    done: Array
    iteration: Array


def fit_view(
    points: Float[Array, "points 3"],
    pixels: Float[Array, "points 2"],
    visible: Bool[Array, "points"],
    intrinsics: Intrinsics,
    pose: SE3,
    free: Bool[Array, "5"],
    rival_rms: Float[Array, ""],
) -> ViewFit:
    """Fit one view from one start, and repeat without gross errors until none is left.

    Args:
        points, pixels, visible: of one view; pixels finite everywhere.
        intrinsics, pose: the start.
        free: which of alpha (common to u and v), alpha_v / alpha_u, u0, v0, k1 are estimated.
        rival_rms: RMS error from another start, px: a minimisation that will not come near it is
            given up. Infinite where there is none.
    """
    alpha_u, alpha_v, u0, v0, k1 = intrinsics
    # Logarithms keep both alphas positive, and their ratio can be held at 1.
    ratio = jnp.where(free[1], jnp.log(alpha_v / alpha_u), 0.0)
    state = _State(jnp.stack([jnp.log(alpha_u), ratio, u0, v0, k1]), pose)

    def fit_and_trim(carry):
        """Fit, then reject points with residuals above 5 times the median residual.

        Repeated, because the largest errors inflate the median at first. A rejected point may
        return in a later round.
        """
        state, used, _, rounds = carry
        state = _minimise(state, points, pixels, used, free, rival_rms)
        residual_norms = jnp.linalg.norm(_residuals(state, points, pixels, visible), axis=0)
        median_residual = jnp.nanmedian(jnp.where(visible, residual_norms, jnp.nan))
        inliers = visible & (residual_norms <= 5.0 * median_residual + 1e-6)
        return state, inliers, jnp.any(inliers != used), rounds + 1

    state, used, _, _ = jax.lax.while_loop(
        lambda carry: carry[2] & (carry[3] < _MAX_TRIMMING_ROUNDS),
        fit_and_trim,
        (state, visible, jnp.any(visible), 0),
    )
    return _view_fit(state, points, pixels, used, free)


def _view_fit(state: _State, points: Array, pixels: Array, used: Array, free: Array) -> ViewFit:
    """Return the result with the relative standard deviation of alpha.

    `var(log alpha) = sigma^2 [(J' J)^-1]_00`, with `sigma^2 = r' r / (2 n - unknowns)`.
    """
    gram = _normal_equations(state, points, pixels, used, free)
    count = jnp.sum(used).astype(float)
    unknowns = jnp.sum(_free_mask(free)).astype(float)
    variance = gram[-1, -1] / jnp.maximum(2.0 * count - unknowns, 1.0)
    # Not below 0.05 px, the best of detectors: a handful of points can be fitted exactly, and
    # alpha would then seem to be determined.
    variance = jnp.maximum(variance, 0.05**2)
    # Unknowns scaled to unit curvature, as in `_damped_step`: pixels and radians differ by orders.
    scale = jnp.sqrt(_positive_or_one(jnp.diag(gram)[:-1]))
    information = gram[:-1, :-1] / scale[:, None] / scale[None]
    information = information + jnp.diag(jnp.where(_free_mask(free), 1e-14, 1.0))
    alpha_unit_variance = jnp.linalg.inv(information)[0, 0] / scale[0] ** 2
    determined = free[0] & jnp.isfinite(alpha_unit_variance) & (alpha_unit_variance > 0.0)
    alpha_relative_std = jnp.where(
        determined, jnp.sqrt(jnp.where(determined, alpha_unit_variance * variance, 1.0)), jnp.inf
    )
    log_alpha, log_ratio, u0, v0, k1 = state.camera_parameters
    intrinsics = Intrinsics(jnp.exp(log_alpha), jnp.exp(log_alpha + log_ratio), u0, v0, k1)
    rms = jnp.sqrt(gram[-1, -1] / jnp.maximum(count, 1.0))
    return ViewFit(intrinsics, state.pose, rms, alpha_relative_std, used)


def _minimise(
    state: _State, points: Array, pixels: Array, used: Array, free: Array, rival_rms: Array
) -> _State:
    """Minimise the cost of Eq. 8 by alternating half-steps, then with all unknowns together."""
    hopeless_cost = (_HOPELESS_RMS_RATIO * rival_rms) ** 2 * jnp.sum(used, dtype=float)

    def cost(state):
        """Return the sum of squared pixel residuals, Eq. 8."""
        return jnp.sum(_residuals(state, points, pixels, used) ** 2)

    def iterate(progress: _LoopState) -> _LoopState:
        """Make one Levenberg-Marquardt step, and the k1 half-step while alternating.

        A step that lowers the cost is accepted and damping falls tenfold; otherwise the state
        stays and damping rises tenfold.
        """
        state, before, damping, joint, _, iteration = progress
        gram = _normal_equations(state, points, pixels, used, free.at[4].set(free[4] & joint))
        trial = _apply_step(state, _damped_step(gram, damping))
        after = cost(trial)
        accepted = after < before
        state, after = where_tree(accepted, (trial, after), (state, before))
        state, after = jax.lax.cond(
            free[4] & ~joint,
            lambda: _radial_half_step(state, after, cost, points, pixels, used),
            lambda: (state, after),
        )
        cost_decrease = before - after
        # A rejected step does not prove convergence; damping this large does: then even a very
        # short gradient step no longer lowers the cost.
        stuck = damping > 1e6
        # The first condition is convergence, the last an exact fit (noise-free data).
        converged = (accepted & (cost_decrease <= 1e-12 * before)) | stuck | (after <= 1e-18)
        # What is left at the last iteration of a cost that falls by the same share in each.
        remaining = jnp.asarray(_MAX_ITERATIONS - iteration, dtype=float)
        foreseen = after * (1.0 - cost_decrease / before) ** remaining
        hopeless = accepted & (foreseen > hopeless_cost)
        slow = (
            (accepted & (cost_decrease <= 1e-3 * before))
            | stuck
            | (iteration >= _MAX_ITERATIONS // 3)
        )
        damping = jnp.maximum(jnp.where(accepted, damping * 0.1, damping * 10.0), 1e-12)
        damping = jnp.where(slow & ~joint, 1e-3, damping)
        return _LoopState(
            state, after, damping, joint | slow, (joint & converged) | hopeless, iteration + 1
        )

    start = _LoopState(
        state,
        cost(state),
        jnp.asarray(1e-3),
        jnp.asarray(False),
        ~jnp.any(used),
        jnp.asarray(0),
    )
    return jax.lax.while_loop(
        lambda p: ~p.done & (p.iteration < _MAX_ITERATIONS), iterate, start
    ).state


def _radial_half_step(state, before, cost, points, pixels, used):
    """Compute k1 by linear least squares, all else held, and keep it if it lowers the cost.

    Eq. 3, `u' = u~ + k1 u~ r~^2`, maps distorted (u~) to ideal (u') coordinates, so with the pose
    given it is linear in k1: `ideal - distorted = k1 distorted r^2`, weighted by alpha (px).
    """
    alpha, centre = _alpha_and_centre(state)
    distorted = (pixels.T - centre) / alpha
    x, y, z = _in_camera(state.pose, points)
    in_front = z > 0.0
    weight = (used & in_front)[None].astype(float) * alpha
    ideal = jnp.stack([x, y]) / jnp.where(in_front, z, 1.0)[None]
    # k1 column = (ideal - distorted) weight, solved for the single unknown by least squares.
    column = distorted * jnp.sum(distorted**2, axis=0, keepdims=True) * weight
    k1 = jnp.sum(column * (ideal - distorted) * weight) / (jnp.sum(column**2) + 1e-300)
    trial = state._replace(camera_parameters=state.camera_parameters.at[4].set(k1))
    after = cost(trial)
    return where_tree(after < before, (trial, after), (state, before))


def _alpha_and_centre(state: _State) -> tuple[Float[Array, "2 1"], Float[Array, "2 1"]]:
    """Return alpha and the principal point for u and v, px."""
    log_alpha, log_ratio, u0, v0, _ = state.camera_parameters
    alpha = jnp.exp(jnp.stack([log_alpha, log_alpha + log_ratio]))
    return alpha[:, None], jnp.stack([u0, v0])[:, None]


def _in_camera(pose: SE3, points: Float[Array, "N 3"]) -> tuple[Array, Array, Array]:
    """Return x, y and z of the points in the camera frame (Eq. 1)."""
    return transformed_coordinates(pose.rotation().as_matrix(), pose.translation(), points)


def _distorted(
    state: _State, in_camera: tuple[Array, Array, Array]
) -> tuple[Float[Array, "2 N"], Bool[Array, "N"]]:
    """Return the distorted normalised points, Eq. 3 solved for them, and which are valid."""
    plane_points, valid = Radial(state.camera_parameters[4]).distort(jnp.stack(in_camera, axis=-1))
    return jnp.where(valid[None], plane_points.T, 0.0), valid


def _residuals(state: _State, points: Array, pixels: Array, used: Array) -> Float[Array, "2 N"]:
    """Return measured minus projected pixels (the residual meant by Eq. 8), zero where unused.

    Pose and projection together are the collinearity equations Eq. 5 and Eq. 6. Eq. 7 prints t_x
    in the rows where t_y and t_z belong, a misprint; all three translations are used here.
    """
    distorted, valid = _distorted(state, _in_camera(state.pose, points))
    alpha, centre = _alpha_and_centre(state)
    return _masked_residuals(alpha * distorted + centre, valid, pixels, used)


def _masked_residuals(
    predicted: Float[Array, "2 N"], valid: Array, pixels: Float[Array, "N 2"], used: Array
) -> Float[Array, "2 N"]:
    """Return measured minus predicted pixels, large without a projection, zero where unused."""
    residual = jnp.where(valid[None], pixels.T - predicted, _UNPROJECTABLE_RESIDUAL)
    return jnp.where(used[None], residual, 0.0)


def _apply_step(state: _State, step: Array) -> _State:
    """Return the state after a step; the pose is updated as `exp(twist) @ pose`."""
    return _State(state.camera_parameters + step[:5], SE3.exp(step[5:]) @ state.pose)


def _free_mask(free: Array) -> Array:
    """Return which of the 5 intrinsics and 6 pose unknowns are free; the pose always is."""
    return jnp.concatenate([free, jnp.ones(6, dtype=bool)])


def _normal_equations(
    state: _State, points: Array, pixels: Array, used: Array, free: Array
) -> Array:
    """Return `[J r]' [J r]`, 12 x 12: the normal matrix J'J, the gradient J'r and the cost r'r.

    J is the derivative of the prediction by 5 intrinsics and 6 pose unknowns, r the residual.
    """
    in_camera = _in_camera(state.pose, points)
    distorted, valid = _distorted(state, in_camera)
    alpha, centre = _alpha_and_centre(state)
    residual = _masked_residuals(alpha * distorted + centre, valid, pixels, used)
    J = _prediction_jacobian(state.camera_parameters[4], alpha, in_camera, distorted)
    J = jnp.where((used & valid)[None, None] & _free_mask(free)[:, None, None], J, 0.0)
    rows = jnp.concatenate([J, residual[None]]).reshape(12, -1)
    return rows @ rows.T


def _prediction_jacobian(
    k1: Array,
    alpha: Float[Array, "2 1"],
    in_camera: tuple[Array, Array, Array],
    distorted: Float[Array, "2 N"],
) -> Float[Array, "11 2 N"]:
    """Return the derivative of the predicted pixels by 5 intrinsics and 6 pose unknowns.

    With `n` the ideal and `d` the distorted normalised point, Eq. 3 is `n = (1 + k1 d.d) d`, so

        dn = a dd + 2 k1 (d.dd) d + (d.d) d dk1,      a = 1 + k1 d.d
        dd = [I - (2 k1 / c) d d'] dn / a - (d.d / c) d dk1,      c = 1 + 3 k1 d.d

    and with the point `p = (x, y, z)` in the camera frame `dn = [I | -n] dp / z`, where `n = a d`.
    """
    # Points are the last axis: XLA computes long rows of numbers faster than many short ones.
    x, y, z = (coordinate[None] for coordinate in in_camera)
    square = jnp.sum(distorted * distorted, axis=0, keepdims=True)
    a, c = 1.0 + k1 * square, 1.0 + 3.0 * k1 * square
    offset = alpha * distorted
    # The derivatives g by the point, and p x g by its rotation: a twist (v, w) from the left
    # displaces a camera-frame point p by dp = v + w x p.
    by_ideal = alpha / (a * z)
    across = by_ideal * (2.0 * k1 / c) * distorted
    gx = by_ideal * jnp.array([[1.0], [0.0]]) - across * distorted[:1]
    gy = by_ideal * jnp.array([[0.0], [1.0]]) - across * distorted[1:]
    gz = -by_ideal * (a * a / c) * distorted
    zeros = jnp.zeros_like(square)
    ones = jnp.ones_like(square)
    return jnp.stack(
        [
            # By log alpha, by the logarithm of the ratio, by u0, v0 and k1.
            offset,
            jnp.concatenate([zeros, offset[1:]]),
            jnp.concatenate([ones, zeros]),
            jnp.concatenate([zeros, ones]),
            -(square / c) * offset,
            gx,
            gy,
            gz,
            y * gz - z * gy,
            z * gx - x * gz,
            x * gy - y * gx,
        ]
    )


def _damped_step(gram: Array, damping: Array) -> Array:
    """Return the Levenberg-Marquardt step, with every unknown scaled to unit curvature.

    `(S^-1 J'J S^-1 + damping I) (S step) = S^-1 J'r`, with `S^2` the diagonal of `J'J`.
    """
    scale = jnp.sqrt(_positive_or_one(jnp.diag(gram)[:-1]))
    matrix = gram[:-1, :-1] / scale[:, None] / scale[None]
    # Held unknowns have zero rows and columns; a one on the diagonal makes their step zero.
    matrix = matrix + jnp.diag(jnp.where(jnp.diag(matrix) > 0.0, damping, 1.0))
    return cho_solve(cho_factor(matrix), gram[:-1, -1] / scale) / scale


def _positive_or_one(values: Array) -> Array:
    """Return the values with one in place of those not positive, for use as a scale."""
    return jnp.where(values > 0.0, values, 1.0)
