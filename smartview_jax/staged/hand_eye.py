"""Step 3: hand-eye and world transforms from `A X = X B`, by BFGS (Eqs. 10 to 17).

    A_ij X = X B_ij,  A_ij = T_i^-1 T_j,  B_ij = C_i^-1 C_j,  X = base_from_world

with `T = tool_from_base` and `C = camera_from_world`. `X` is yaw-pitch-roll and a translation, and
minimises the sum over all i != j of the squared Frobenius norm of `A X - X B` (Eq. 17). That norm
adds radians to metres, so the answer depends on the unit of length: metres here, unless a length
scale is given.
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


class StartTried(NamedTuple):
    """One start of the search and what came of it."""

    name: str
    start_cost: float
    cost: float
    converged: bool
    message: str


class HandEyeResult(eqx.Module):
    """Step 3's answer.

    Attributes:
        holder_from_world: where the target stands.
        camera_from_mount: the hand-eye transform from the first answer, averaged over the views.
            The errors of the two then cancel in the chain, so this is the answer to use.
        camera_from_mount_same_form: the hand-eye transform found by itself, from the same form
            with the roles exchanged (`C_j C_i^-1 X = X T_j T_i^-1`).
        difference: between the two, translation (m) and rotation (rad).
        starts: every start tried for `holder_from_world`.
        hand_eye_starts: every start tried for `camera_from_mount`.
        chosen: the names of the starts that won.
        converged, message: whether both searches did.
    """

    holder_from_world: SE3
    camera_from_mount: SE3
    camera_from_mount_same_form: SE3
    difference: tuple[float, float] = eqx.field(static=True)
    starts: tuple[StartTried, ...] = eqx.field(static=True)
    hand_eye_starts: tuple[StartTried, ...] = eqx.field(static=True)
    chosen: tuple[str, str] = eqx.field(static=True)
    converged: bool = eqx.field(static=True)
    message: str = eqx.field(static=True)


def solve_hand_eye(
    mount_from_holder: SE3,
    camera_from_world: SE3,
    weights: Float[Array, "views"] | None = None,
    rough_translation: Float[Array, "3"] | np.ndarray | None = None,
    length_scale: float = 1.0,
) -> HandEyeResult:
    """Both transforms from robot poses and camera poses, `(views)` each.

    Args:
        mount_from_holder: `tool_from_base` for a camera on the hand.
        camera_from_world: the extrinsics of Step 2.
        weights: of the views; zero leaves one out. All alike by default.
        rough_translation: the user's rough `holder_from_world` translation, m, for the paper's
            start; zero if not given.
        length_scale: metres per unit of length in Eq. 17; smaller gives translation more weight.

    Raises:
        ValueError: fewer than three views.
    """
    count = len(mount_from_holder.wxyz_xyz)
    weights = jnp.ones(count) if weights is None else jnp.asarray(weights, dtype=float)
    if np.count_nonzero(np.asarray(weights)) < 3:
        found = np.count_nonzero(np.asarray(weights))
        raise ValueError(f"Step 3 needs at least 3 views, found {found}")
    forms = _closed_forms(mount_from_holder, camera_from_world, weights)
    rough = jnp.zeros(3) if rough_translation is None else jnp.asarray(rough_translation, float)
    paper = SE3.from_rotation_and_translation(SO3.identity(), rough)

    T, C = mount_from_holder, camera_from_world
    world_starts = {PAPER_START: paper, **{name: form[1] for name, form in forms.items()}}
    world, world_tried, world_best = _search(T, C, weights, world_starts, length_scale)
    # The other form has the inverses in the places of T and C: A = C_j C_i^-1, B = T_j T_i^-1.
    eye_starts = {
        PAPER_START: SE3.identity(),
        **{name: form[0] for name, form in forms.items()},
    }
    eye, eye_tried, eye_best = _search(C.inverse(), T.inverse(), weights, eye_starts, length_scale)

    averaged, gap = (np.asarray(x) for x in _averaged(T, C, world, eye, weights))
    converged = world_best.converged and eye_best.converged
    return HandEyeResult(
        world,
        SE3(jnp.asarray(averaged)),
        eye,
        (float(np.linalg.norm(gap[:3])), float(np.linalg.norm(gap[3:]))),
        world_tried,
        eye_tried,
        (world_best.name, eye_best.name),
        converged,
        "converged" if converged else "BFGS did not converge; the best of its answers was taken",
    )


@compiled
def _averaged(T: SE3, C: SE3, world: SE3, eye: SE3, weights: Array) -> tuple[Array, Array]:
    """`camera_from_mount` from the world transform, averaged, and its distance to the other."""
    averaged = mean_pose(C @ (T @ SE3(world.wxyz_xyz[None])).inverse(), weights)
    return averaged.wxyz_xyz, (averaged.inverse() @ eye).log()


def frobenius_cost(
    X: SE3,
    T: SE3,
    C: SE3,
    weights: Float[Array, "views"],
    length_scale: float | Float[Array, ""] = 1.0,
) -> Float[Array, ""]:
    """Eq. 17: `sum over i != j of || T_i^-1 T_j X - X C_i^-1 C_j ||_F^2`, pairs weighted."""
    unit = jnp.asarray(length_scale, dtype=float)
    A = (SE3(T.wxyz_xyz[:, None]).inverse() @ SE3(T.wxyz_xyz[None])).as_matrix()
    B = (SE3(C.wxyz_xyz[:, None]).inverse() @ SE3(C.wxyz_xyz[None])).as_matrix()
    gap = A @ X.as_matrix()[None, None] - X.as_matrix()[None, None] @ B
    gap = gap.at[..., :3, 3].divide(unit)
    return jnp.einsum("i,j,ijab->", weights, weights, gap**2)


@compiled
def _closed_forms(
    mount_from_holder: SE3, camera_from_world: SE3, weights: Array
) -> dict[str, tuple[SE3, SE3]]:
    return {
        name: form(mount_from_holder, camera_from_world, weights)
        for name, form in CLOSED_FORMS.items()
    }


def _search(
    T: SE3, C: SE3, weights: Array, starts: dict[str, SE3], length_scale: float
) -> tuple[SE3, tuple[StartTried, ...], StartTried]:
    """BFGS from every start; the lowest finite cost wins."""
    stacked = SE3(jnp.stack([start.wxyz_xyz for start in starts.values()]))
    finite = jnp.all(jnp.isfinite(stacked.wxyz_xyz), axis=-1)
    safe = jnp.where(finite[:, None], stacked.wxyz_xyz, SE3.identity().wxyz_xyz[None])
    found, before, after, converged = _bfgs(T, C, weights, SE3(safe), jnp.asarray(length_scale))
    after = jnp.where(finite & jnp.isfinite(after), after, jnp.inf)
    tried = tuple(
        StartTried(
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
    best = min(range(len(tried)), key=lambda k: (tried[k].cost, k))
    return SE3(found.wxyz_xyz[best]), tried, tried[best]


@compiled
def _bfgs(
    T: SE3, C: SE3, weights: Array, starts: SE3, length_scale: Array
) -> tuple[SE3, Array, Array, Array]:
    solver = optx.BFGS(rtol=1e-12, atol=1e-12)
    pairs = jnp.sum(weights) ** 2

    def transform(start: SE3, numbers: Array) -> SE3:
        """Yaw-pitch-roll (Eq. 16) about the start, so that no start sits at the gimbal."""
        turn = SO3.from_rpy_radians(numbers[2], numbers[1], numbers[0])
        return SE3.from_rotation_and_translation(
            start.rotation() @ turn, start.translation() + numbers[3:]
        )

    def cost(numbers, start):
        return frobenius_cost(transform(start, numbers), T, C, weights, length_scale) / pairs

    def one(wxyz_xyz):
        start = SE3(wxyz_xyz)
        solution = optx.minimise(cost, solver, jnp.zeros(6), args=start, max_steps=300, throw=False)
        numbers = solution.value
        gradient = jax.grad(cost)(numbers, start)
        after = cost(numbers, start)
        # BFGS stops where its line search finds nothing lower: at the optimum that is convergence.
        settled = (solution.result == optx.RESULTS.successful) | (
            jnp.max(jnp.abs(gradient)) < 1e-7 * (1.0 + after)
        )
        found = transform(start, numbers).wxyz_xyz
        return found, cost(jnp.zeros(6), start) * pairs, after * pairs, settled

    found, before, after, settled = jax.vmap(one)(starts.wxyz_xyz)
    return SE3(found), before, after, settled
