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

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float
from scipy.optimize import minimize

from ..dataset import require_motion, undetermined_twists
from ..geometry import host_logarithms, host_matrices, host_poses, host_transforms
from ..runtime.modules import HostModule
from .closed_form import CLOSED_FORMS, mean_camera_from_mount
from .frobenius import frobenius_factor
from .minimum_norm import minimum_norm_transforms

PAPER_START = "paper: rotation identity"
"""The name of the paper's start: identity rotation and a roughly known translation."""

MINIMUM_NORM_START = "minimum norm"
"""The name of the search where the motion leaves directions undetermined (`minimum_norm.py`)."""


class SearchRecord(NamedTuple):
    """The record of one search: its start, its cost before and after, and its outcome."""

    name: str
    initial_cost: float
    final_cost: float
    converged: bool
    message: str


class HandEyeResult(HostModule):
    """The result of Step 3: hand-eye and world transforms, and the record of both searches.

    Attributes:
        holder_from_world: pose of the target, by minimising Eq. 17.
        camera_from_mount: the hand-eye transform computed from `holder_from_world` and averaged
            over the views. The errors of the two then cancel in the chain, so use this one.
        hand_eye_difference: from `camera_from_mount` to the hand-eye transform by minimising the
            same cost for the other unknown (`C_j C_i^-1 X = X T_j T_i^-1`), translation (m) and
            rotation (rad).
        searches: every start tried for `holder_from_world`.
        best_starts: names of the two starts that reached the lowest cost.
        converged: whether both searches converged.
        message: the same in words.
    """

    holder_from_world: SE3
    camera_from_mount: SE3
    hand_eye_difference: tuple[float, float] = eqx.field(static=True)
    searches: tuple[SearchRecord, ...] = eqx.field(static=True)
    best_starts: tuple[str, str] = eqx.field(static=True)
    converged: bool = eqx.field(static=True)
    message: str = eqx.field(static=True)


def solve_hand_eye(
    mount_from_holder: SE3,
    camera_from_world: SE3,
    weights: Float[Array, "views"] | Float[np.ndarray, "views"] | None = None,
    rough_translation: Float[Array, "3"] | np.ndarray | None = None,
    length_scale: float = 1.0,
    start: tuple[SE3 | None, SE3 | None] = (None, None),
    camera_on_hand: bool = False,
) -> HandEyeResult:
    """Compute hand-eye and world transforms from robot poses and camera poses, `(views)` each.

    A direction that the motion does not determine, such as the camera's place along the only axis
    about which the robot turned, stays where it starts.

    Args:
        mount_from_holder: `tool_from_base` for a camera on the hand.
        camera_from_world: the extrinsics of Step 2.
        weights: of the views; zero leaves a view out. Equal by default.
        rough_translation: the user's rough `holder_from_world` translation, m, for the paper's
            start; zero if not given.
        length_scale: metres per unit of length in Eq. 17; smaller gives translation more weight.
        start: `camera_from_mount` and `holder_from_world` as far as they are known; the first that
            is given decides what the motion leaves undetermined.
        camera_on_hand: without a start, whether the camera comes as near as possible to the origin
            of its mount along such a direction, or the target to the origin of its holder.

    Raises:
        ValueError: fewer than three different poses, or a robot that never turned without a start
            or a rough translation.
    """
    T, C = host_matrices(mount_from_holder), host_matrices(camera_from_world)
    w = np.ones(len(T)) if weights is None else np.asarray(weights, dtype=float)
    # Two motions about different axes are needed, hence three views.
    if np.count_nonzero(w) < 3:
        raise ValueError(f"Step 3 needs at least 3 views, found {np.count_nonzero(w)}")
    known = [None if pose is None else host_matrices(pose) for pose in start]
    if rough_translation is not None and known[1] is None and known[0] is None:
        known[1] = np.eye(4)
        known[1][:3, 3] = np.asarray(rough_translation)
    used = w != 0.0
    finite = np.isfinite(T).all() and np.isfinite(C).all()
    if finite:
        place_is_given = any(pose is not None for pose in known)
        require_motion(T[used], "camera_from_mount", place_is_given)
    if finite and len(undetermined_twists(T[used])):
        initial = np.eye(4) if known[1] is None else known[1]
        transforms = minimum_norm_transforms(T[used], C[used], (known[0], known[1]), camera_on_hand)
        factor = frobenius_factor(T[used], C[used], w[used], length_scale)
        return _minimum_norm_result(*transforms, initial, factor)
    paper_start = np.eye(4)
    if rough_translation is not None:
        paper_start[:3, 3] = np.asarray(rough_translation)
    # The closed forms are starts in addition to the paper's.
    closed_forms = {name: form.of_matrices(T, C, w) for name, form in CLOSED_FORMS.items()}
    return _by_both_searches(T[used], C[used], w[used], paper_start, closed_forms, length_scale)


def _by_both_searches(
    T: Float[np.ndarray, "views 4 4"],
    C: Float[np.ndarray, "views 4 4"],
    w: Float[np.ndarray, "views"],
    paper_start: Float[np.ndarray, "4 4"],
    closed_forms: Mapping[str, tuple[Float[np.ndarray, "4 4"], ...]],
    length_scale: float,
) -> HandEyeResult:
    """Return the world transform by the paper's search, the hand-eye transform by averaging.

    Args:
        T, C: robot poses and camera poses, as in `solve_hand_eye`.
        w: weights of the views, above zero.
        paper_start: start of `holder_from_world`.
        closed_forms: further starts by name, of `camera_from_mount` and `holder_from_world`.
        length_scale: as in `solve_hand_eye`.
    """
    total = float(w.sum())
    # First search: X = holder_from_world in T_i^-1 T_j X = X C_i^-1 C_j (Eq. 17).
    world_solution, world_searches, world_best = _search(
        frobenius_factor(T, C, w, length_scale) / total,
        total**2,
        {PAPER_START: paper_start, **{name: form[1] for name, form in closed_forms.items()}},
    )
    # Eliminating base_from_world instead of camera_from_tool from Eq. 10 gives
    #     C_j C_i^-1 X = X T_j T_i^-1,  X = camera_from_tool,
    # which is the same search with C^-1 and T^-1 in the roles of T and C.
    hand_eye_solution, _, hand_eye_best = _search(
        frobenius_factor(np.linalg.inv(C), np.linalg.inv(T), w, length_scale) / total,
        total**2,
        {PAPER_START: np.eye(4), **{name: form[0] for name, form in closed_forms.items()}},
    )
    averaged = mean_camera_from_mount(world_solution, T, C, w)
    difference = host_logarithms(np.linalg.inv(averaged) @ hand_eye_solution)
    converged = world_best.converged and hand_eye_best.converged
    # JAX arrays, so that users can differentiate; `device_put` compiles no program.
    holder_from_world, camera_from_mount = jax.device_put(
        tuple(map(host_transforms, (world_solution, averaged)))
    )
    return HandEyeResult(
        holder_from_world,
        camera_from_mount,
        (float(np.linalg.norm(difference[:3])), float(np.linalg.norm(difference[3:]))),
        world_searches,
        (world_best.name, hand_eye_best.name),
        converged,
        "converged" if converged else "the best search did not converge; its answer was taken",
    )


def _minimum_norm_result(
    camera: Float[np.ndarray, "4 4"],
    world: Float[np.ndarray, "4 4"],
    initial: Float[np.ndarray, "4 4"],
    factor: Float[np.ndarray, "rows 13"],
) -> HandEyeResult:
    """Return the result for a motion that leaves directions of the transforms undetermined.

    Eq. 17 has no single minimum there, and noise of the camera's rotations would choose one.
    """
    entries = [np.append(pose[:3, :3].ravel(), [*pose[:3, 3], 1.0]) for pose in (initial, world)]
    costs = [float(np.sum(np.square(factor @ x))) for x in entries]
    record = SearchRecord(MINIMUM_NORM_START, costs[0], costs[1], True, "converged")
    camera_from_mount, holder_from_world = (
        jax.device_put(host_transforms(pose)) for pose in (camera, world)
    )
    return HandEyeResult(
        holder_from_world,
        camera_from_mount,
        (0.0, 0.0),
        (record,),
        (MINIMUM_NORM_START, MINIMUM_NORM_START),
        True,
        "converged; the robot's motion leaves directions undetermined, which stay at their start",
    )


def _search(
    factor: Float[np.ndarray, "rows 13"],
    pair_weight: float,
    starts: dict[str, Float[np.ndarray, "4 4"]],
) -> tuple[Float[np.ndarray, "4 4"], tuple[SearchRecord, ...], SearchRecord]:
    """Minimise the mean cost of a pair from every start, and return the result of lowest cost.

    Args:
        factor: the matrix of `frobenius_factor` for the mean over the pairs, so that tolerances do
            not depend on their number.
        pair_weight: total weight of the pairs. Costs are recorded as sums, as Eq. 17 states them.
        starts: 4x4 matrices by name.
    """
    # The closed forms are near the minimum; from the paper's start BFGS searches, as in the paper.
    solutions = [_minimise(factor, start, name != PAPER_START) for name, start in starts.items()]
    records = tuple(
        SearchRecord(
            name,
            pair_weight * end.initial_cost,
            pair_weight * end.final_cost,
            end.converged,
            # Closed forms give NaN for degenerate motions.
            "the start is not finite: the motions do not determine it"
            if not np.isfinite(start).all()
            else "converged"
            if end.converged
            else "did not converge",
        )
        for (name, start), end in zip(starts.items(), solutions, strict=True)
    )
    # Costs that are equal to rounding go to the earlier start, so that the paper's own start is
    # named if it suffices.
    lowest = min(end.final_cost for end in solutions)
    best = next(
        k for k, end in enumerate(solutions) if end.final_cost <= lowest * (1.0 + 1e-9) + 1e-24
    )
    return solutions[best].pose, records, records[best]


class _Minimum(NamedTuple):
    """The result of one search: its pose, and the mean cost of a pair before and after."""

    pose: Float[np.ndarray, "4 4"]
    initial_cost: float
    final_cost: float
    converged: bool


def _minimise(
    factor: Float[np.ndarray, "rows 13"], start: Float[np.ndarray, "4 4"], is_near: bool
) -> _Minimum:
    """Minimise `|| factor x ||^2` over yaw, pitch, roll and translation from a start.

    BFGS searches as in the paper. Near the minimum Gauss-Newton is tried first, which takes a
    fraction of its time.
    """
    after_start = _after_start(factor, start)

    def cost(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the cost and its gradient."""
        entries, slopes = _turn_and_slopes(parameters)
        residual = after_start @ entries
        by_entry = 2.0 * (residual @ after_start)
        return float(residual @ residual), np.concatenate([slopes @ by_entry[:9], by_entry[9:12]])

    before, slope = cost(np.zeros(6))
    if not np.isfinite(before):
        return _Minimum(start, np.nan, np.inf, False)
    search = _SearchEnd(np.zeros(6), before, float(np.abs(slope).max()), False)
    if is_near:
        search = _gauss_newton(cost, after_start, search)
    for tolerance in _GRADIENT_TOLERANCES:
        if search.gradient <= _GRADIENT_TOLERANCES[1] * (1.0 + search.cost):
            break
        search = _search_from(cost, after_start, tolerance)
    turn = _turn_and_slopes(search.parameters)[0][:9].reshape(3, 3)
    pose = host_poses(start[:3, :3] @ turn, start[:3, 3] + search.parameters[3:])
    # Without a lower cost along the gradient BFGS reports a failure, also at the optimum.
    converged = search.succeeded or search.gradient < 1e-7 * (1.0 + search.cost)
    return _Minimum(pose, before, search.cost, converged)


class _SearchEnd(NamedTuple):
    """The end of one search: parameters, cost, largest gradient, and whether BFGS succeeded."""

    parameters: np.ndarray
    cost: float
    gradient: float
    succeeded: bool


def _search_from(
    cost: Callable[[np.ndarray], tuple[float, np.ndarray]],
    after_start: Float[np.ndarray, "rows 13"],
    tolerance: float,
) -> _SearchEnd:
    """Search by BFGS to a gradient, then by Gauss-Newton as long as the gradient falls.

    BFGS stops where rounding hides differences of the cost; the gradient is then still far above
    its own rounding. Gauss-Newton steps, which need no cost, bring it down.
    """
    optimum = minimize(
        cost, np.zeros(6), jac=True, method="BFGS", options={"gtol": tolerance, "maxiter": 300}
    )
    least, slope = cost(optimum.x)
    end = _SearchEnd(optimum.x, least, float(np.abs(slope).max()), bool(optimum.success))
    return _gauss_newton(cost, after_start, end)


def _gauss_newton(
    cost: Callable[[np.ndarray], tuple[float, np.ndarray]],
    after_start: Float[np.ndarray, "rows 13"],
    search: _SearchEnd,
) -> _SearchEnd:
    """Go on with a search by Gauss-Newton steps as long as the gradient falls."""
    for _ in range(_MAX_GAUSS_NEWTON_STEPS):
        entries, slopes = _turn_and_slopes(search.parameters)
        derivative = np.concatenate([after_start[:, :9] @ slopes.T, after_start[:, 9:12]], axis=1)
        trial = search.parameters - np.linalg.lstsq(derivative, after_start @ entries)[0]
        trial_cost, slope = cost(trial)
        gradient = float(np.abs(slope).max())
        if not gradient < search.gradient or trial_cost > search.cost * (1.0 + 1e-12):
            break
        search = _SearchEnd(trial, trial_cost, gradient, search.succeeded)
    return search


_GRADIENT_TOLERANCES = (1e-4, 1e-10)
"""Gradients at which BFGS stops; the second if Gauss-Newton steps from the first do not reach it.

The first is a tenth of a milliradian from the minimum, from where Gauss-Newton steps converge in a
fraction of BFGS's steps.
"""

_MAX_GAUSS_NEWTON_STEPS = 20
"""Largest number of Gauss-Newton steps in a row. Each gains a factor of about the cost's root."""


def _after_start(
    factor: Float[np.ndarray, "rows 13"], start: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "rows 13"]:
    """Return the factor of a turn and a shift after a start, in the order of `frobenius_factor`.

    X is `start` times `Rz Ry Rx` (Eq. 16), so that no start is at gimbal lock; its translation is
    the start's plus the shift.
    """
    by_turn = start[:3, :3].T @ factor[:, :9].reshape(-1, 3, 3)
    constant = factor[:, 12] + factor[:, 9:12] @ start[:3, 3]
    return np.column_stack([by_turn.reshape(-1, 9), factor[:, 9:12], constant])


def _turn_and_slopes(
    parameters: Float[np.ndarray, "6"],
) -> tuple[Float[np.ndarray, "13"], Float[np.ndarray, "3 9"]]:
    """Return `Rz Ry Rx`, the shift and one; and the turn's derivatives by yaw, pitch and roll."""
    yaw, pitch, roll, *shift = parameters.tolist()
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    cr, sr = math.cos(roll), math.sin(roll)
    # The rows of Rz Ry Rx. The yaw mixes the first two, and the roll the last two columns.
    u1, u2, u3 = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    v1, v2, v3 = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    w1, w2, w3 = -sp, cp * sr, cp * cr
    slopes = (
        (-v1, -v2, -v3, u1, u2, u3, 0.0, 0.0, 0.0),
        (cy * w1, cy * w2, cy * w3, sy * w1, sy * w2, sy * w3, -cp, -sp * sr, -sp * cr),
        (0.0, u3, -u2, 0.0, v3, -v2, 0.0, w3, -w2),
    )
    return np.array((u1, u2, u3, v1, v2, v3, w1, w2, w3, *shift, 1.0)), np.array(slopes)
