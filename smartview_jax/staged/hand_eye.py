"""Compute the hand-eye and world transforms from `A X = X B` by BFGS (Step 3 of the paper).

Every view i has the chain `C_i = H T_i X` (Eq. 10), with `C = camera_from_world`,
`T = tool_from_base`, `H = camera_from_tool` and `X = base_from_world`. Eliminating H between two
views, `C_i^-1 C_j = X^-1 T_i^-1 T_j X`, leaves

    A_ij X = X B_ij,  A_ij = T_i^-1 T_j,  B_ij = C_i^-1 C_j

The paper writes this derivation in Eq. 11, Eq. 12, Eq. 13, Eq. 14 and Eq. 15. X is yaw, pitch, roll
(Eq. 16) and a translation, and minimises the sum over all i != j of the squared Frobenius norm of
`A X - X B` (Eq. 17).

Known weakness of Eq. 17: the norm adds dimensionless rotation entries (radians) to metres, so the
result depends on the unit of length. It is the metre here, unless a length scale is given.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxlie import SE3, SO3
from jaxtyping import Array, Float

from ..compilation import compiled
from ..geometry import mean_pose
from .closed_form import CLOSED_FORMS

PAPER_START = "paper: rotation identity"
"""The name of the paper's start: identity rotation and a roughly known translation."""


class SearchRecord(NamedTuple):
    """The record of one BFGS search: its start, its cost before and after, and its outcome."""

    name: str
    initial_cost: float
    final_cost: float
    converged: bool
    message: str


class HandEyeResult(eqx.Module):
    """The result of Step 3: hand-eye and world transforms, and the record of both searches.

    Attributes:
        holder_from_world: pose of the target, by minimising Eq. 17.
        camera_from_mount: the hand-eye transform computed from `holder_from_world` and averaged
            over the views. The errors of the two then cancel in the chain, so use this one.
        camera_from_mount_direct: the hand-eye transform by minimising the same cost for the
            other unknown (`C_j C_i^-1 X = X T_j T_i^-1`).
        hand_eye_difference: between the two hand-eye transforms, translation (m) and rotation
            (rad).
        searches: every start tried for `holder_from_world`.
        hand_eye_searches: every start tried for `camera_from_mount`.
        best_starts: names of the two starts that reached the lowest cost.
        converged: whether both searches converged.
        message: the same in words.
    """

    holder_from_world: SE3
    camera_from_mount: SE3
    camera_from_mount_direct: SE3
    hand_eye_difference: tuple[float, float] = eqx.field(static=True)
    searches: tuple[SearchRecord, ...] = eqx.field(static=True)
    hand_eye_searches: tuple[SearchRecord, ...] = eqx.field(static=True)
    best_starts: tuple[str, str] = eqx.field(static=True)
    converged: bool = eqx.field(static=True)
    message: str = eqx.field(static=True)


def solve_hand_eye(
    mount_from_holder: SE3,
    camera_from_world: SE3,
    weights: Float[Array, "views"] | None = None,
    rough_translation: Float[Array, "3"] | np.ndarray | None = None,
    length_scale: float = 1.0,
) -> HandEyeResult:
    """Compute hand-eye and world transforms from robot poses and camera poses, `(views)` each.

    Args:
        mount_from_holder: `tool_from_base` for a camera on the hand.
        camera_from_world: the extrinsics of Step 2.
        weights: of the views; zero leaves a view out. Equal by default.
        rough_translation: the user's rough `holder_from_world` translation, m, for the paper's
            start; zero if not given.
        length_scale: metres per unit of length in Eq. 17; smaller gives translation more weight.

    Raises:
        ValueError: fewer than three views.
    """
    views = len(mount_from_holder.wxyz_xyz)
    weights = jnp.ones(views) if weights is None else jnp.asarray(weights, dtype=float)
    # Two motions about different axes are needed, hence three views.
    used_count = np.count_nonzero(np.asarray(weights))
    if used_count < 3:
        raise ValueError(f"Step 3 needs at least 3 views, found {used_count}")
    closed_forms = _closed_forms(mount_from_holder, camera_from_world, weights)
    rough = jnp.zeros(3) if rough_translation is None else jnp.asarray(rough_translation, float)
    paper_start = SE3.from_rotation_and_translation(SO3.identity(), rough)

    T, C = mount_from_holder, camera_from_world
    # First search: X = holder_from_world in T_i^-1 T_j X = X C_i^-1 C_j (Eq. 17).
    world_starts = {
        PAPER_START: paper_start,
        **{name: form[1] for name, form in closed_forms.items()},
    }
    world_solution, world_searches, world_best = _search(T, C, weights, world_starts, length_scale)
    # Eliminating base_from_world instead of camera_from_tool from Eq. 10 gives
    #     C_j C_i^-1 X = X T_j T_i^-1,  X = camera_from_tool,
    # which is the same search with C^-1 and T^-1 in the roles of T and C.
    hand_eye_starts = {
        PAPER_START: SE3.identity(),
        **{name: form[0] for name, form in closed_forms.items()},
    }
    hand_eye_solution, hand_eye_searches, hand_eye_best = _search(
        C.inverse(), T.inverse(), weights, hand_eye_starts, length_scale
    )

    averaged, difference = (
        np.asarray(x)
        for x in _mean_camera_from_mount(T, C, world_solution, hand_eye_solution, weights)
    )
    converged = world_best.converged and hand_eye_best.converged
    return HandEyeResult(
        world_solution,
        SE3(jnp.asarray(averaged)),
        hand_eye_solution,
        (float(np.linalg.norm(difference[:3])), float(np.linalg.norm(difference[3:]))),
        world_searches,
        hand_eye_searches,
        (world_best.name, hand_eye_best.name),
        converged,
        "converged" if converged else "BFGS did not converge; the best of its answers was taken",
    )


@compiled
def _mean_camera_from_mount(
    T: SE3, C: SE3, holder_from_world: SE3, camera_from_mount_direct: SE3, weights: Array
) -> tuple[Array, Array]:
    """Return `camera_from_mount` averaged over the views, and the twist to the direct solution.

    By Eq. 10 every view gives one estimate, `C_i (T_i X)^-1` with `X = holder_from_world`.
    """
    averaged = mean_pose(C @ (T @ SE3(holder_from_world.wxyz_xyz[None])).inverse(), weights)
    return averaged.wxyz_xyz, (averaged.inverse() @ camera_from_mount_direct).log()


def frobenius_cost(
    X: SE3,
    T: SE3,
    C: SE3,
    weights: Float[Array, "views"],
    length_scale: float | Float[Array, ""] = 1.0,
) -> Float[Array, ""]:
    """Return the cost of Eq. 17, `sum over i != j of || T_i^-1 T_j X - X C_i^-1 C_j ||_F^2`.

    Pairs are weighted by the product of the weights of their views. The norm adds rotation entries
    to lengths, so its minimum depends on the unit of length, `length_scale` metres.
    """
    unit = jnp.asarray(length_scale, dtype=float)
    A = (SE3(T.wxyz_xyz[:, None]).inverse() @ SE3(T.wxyz_xyz[None])).as_matrix()
    B = (SE3(C.wxyz_xyz[:, None]).inverse() @ SE3(C.wxyz_xyz[None])).as_matrix()
    # Pairs with i = j have A = B = I and add nothing, so they need no mask.
    residual = A @ X.as_matrix()[None, None] - X.as_matrix()[None, None] @ B
    # Translations in the chosen unit of length: the last column of the 4x4 residual.
    residual = residual.at[..., :3, 3].divide(unit)
    return jnp.einsum("i,j,ijab->", weights, weights, residual**2)


@compiled
def _closed_forms(
    mount_from_holder: SE3, camera_from_world: SE3, weights: Array
) -> dict[str, tuple[SE3, SE3]]:
    """Return both transforms by every closed form; they are further starts beside the paper's."""
    return {
        name: form(mount_from_holder, camera_from_world, weights)
        for name, form in CLOSED_FORMS.items()
    }


def _search(
    T: SE3, C: SE3, weights: Array, starts: dict[str, SE3], length_scale: float
) -> tuple[SE3, tuple[SearchRecord, ...], SearchRecord]:
    """Run BFGS from every start and return the result with the lowest finite cost."""
    stacked = SE3(jnp.stack([start.wxyz_xyz for start in starts.values()]))
    finite = jnp.all(jnp.isfinite(stacked.wxyz_xyz), axis=-1)
    # Closed forms give NaN for degenerate motions; one such start must not spoil the batch.
    finite_starts = jnp.where(finite[:, None], stacked.wxyz_xyz, SE3.identity().wxyz_xyz[None])
    solutions, before, after, converged = _bfgs(
        T, C, weights, SE3(finite_starts), jnp.asarray(length_scale)
    )
    after = jnp.where(finite & jnp.isfinite(after), after, jnp.inf)
    records = tuple(
        SearchRecord(
            name,
            float(before[k]) if finite[k] else float("nan"),
            float(after[k]),
            bool(converged[k] & finite[k]),
            "the start is not finite: the motions do not determine it"
            if not finite[k]
            else "converged"
            if converged[k]
            else "did not converge",
        )
        for k, name in enumerate(starts)
    )
    # Equal costs go to the earlier start, so that the paper's own start is named if it suffices.
    best = min(range(len(records)), key=lambda k: (records[k].final_cost, k))
    return SE3(solutions.wxyz_xyz[best]), records, records[best]


@compiled
def _bfgs(
    T: SE3, C: SE3, weights: Array, starts: SE3, length_scale: Array
) -> tuple[SE3, Array, Array, Array]:
    """Minimise the cost of Eq. 17 from every start.

    Returns:
        The transforms, the costs before and after, and whether each search converged.
    """
    solver = optx.BFGS(rtol=1e-12, atol=1e-12)
    # The mean over pairs is minimised, so that the tolerances do not depend on their number.
    pair_weight = jnp.sum(weights) ** 2

    def transform(start: SE3, parameters: Array) -> SE3:
        """Return `start` times `Rz Ry Rx` (Eq. 16), so that no start is at gimbal lock."""
        rotation = SO3.from_rpy_radians(parameters[2], parameters[1], parameters[0])
        return SE3.from_rotation_and_translation(
            start.rotation() @ rotation, start.translation() + parameters[3:]
        )

    def cost(parameters, start):
        """Return the cost of Eq. 17 divided by the total weight of the pairs."""
        return (
            frobenius_cost(transform(start, parameters), T, C, weights, length_scale) / pair_weight
        )

    def search(wxyz_xyz):
        """Run one search and return its pose, the costs before and after, and convergence."""
        start = SE3(wxyz_xyz)
        solution = optx.minimise(cost, solver, jnp.zeros(6), args=start, max_steps=300, throw=False)
        parameters = solution.value
        gradient = jax.grad(cost)(parameters, start)
        after = cost(parameters, start)
        # BFGS also fails when its line search finds no lower cost. With a zero gradient that is
        # convergence to the limit of rounding, not a failure.
        has_converged = (solution.result == optx.RESULTS.successful) | (
            jnp.max(jnp.abs(gradient)) < 1e-7 * (1.0 + after)
        )
        # The costs are returned as sums over the pairs, as Eq. 17 states them.
        before = cost(jnp.zeros(6), start)
        pose = transform(start, parameters).wxyz_xyz
        return pose, before * pair_weight, after * pair_weight, has_converged

    solutions, before, after, has_converged = jax.vmap(search)(starts.wxyz_xyz)
    return SE3(solutions), before, after, has_converged
