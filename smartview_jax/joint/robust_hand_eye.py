"""Find which pairs of a robot pose and a tracked pose agree, before any fit.

Closed forms are solved on triples of pairs, drawn at random. Each solution predicts all tracked
poses; the errors of pairs that agree with it are normal, with standard deviations that are
estimated, and wrong pairs are anywhere in the space of the tracked poses. The solution with the
largest likelihood is kept, as in MLESAC (Torr and Zisserman, 2000), so that even more than half of
the pairs may be wrong.
"""

import itertools
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..dataset import MINIMUM_RELIABLE_VIEWS, UNIT_ROTATION, UNIT_TRANSLATION
from ..geometry import (
    host_nearest_rotation,
    host_poses,
    host_rotation_angles,
    host_rotation_vectors,
)
from ..hand_eye import CLOSED_FORMS, ClosedForm, mean_holder_from_world, motion_pairs

TRIPLES = 200
"""Number of triples: with half of all pairs wrong, none is right once in 10^11."""

REFINED = 3
"""Number of the likeliest solutions that are solved again from all pairs that agree with them."""

ROUNDS = 5
"""Largest number of times that the agreeing pairs are solved and chosen again."""

MIN_AGREEING, MIN_SHARE = 5, 1.0 / 3.0
"""Smallest number of agreeing pairs, and their smallest share, that are no chance: of pairs in
random order three agree, those from which a solution was found."""

SOLVED_PAIRS = 3
"""Number of pairs from which a solution is found."""

MIXTURE_ROUNDS = 20
"""Number of rounds in which errors and membership are estimated in turn."""

PRIOR_NUMBERS = 3.0
"""Weight of the usual noise of trackers in the estimate of the errors, in numbers observed: as many
as one pair has, so that a triple that happens to fit exactly has no likelihood without bound."""

_Matrices = Float[np.ndarray, "views 4 4"]


def robust_hand_eye(
    mount_from_holder: _Matrices,
    camera_from_world: _Matrices,
    seen: Bool[np.ndarray, "views"],
    scale: bool,
) -> tuple[float, Bool[np.ndarray, "views"]]:
    """Return the tracker's unit of length and the pairs that agree with the majority.

    Args:
        mount_from_holder: the robot's part of the chain.
        camera_from_world: tracked poses.
        seen: the pairs to use.
        scale: whether the tracker's unit is unknown.

    Returns:
        Metres per unit of the tracker, 1 if it is known; and a mask. All pairs that were seen agree
        if there are at most `MINIMUM_RELIABLE_VIEWS`, if the motion does not determine the
        transforms, or if so few agree with any solution as could by chance.
    """
    views = np.flatnonzero(seen)
    T, C = mount_from_holder[views], camera_from_world[views]
    if len(views) <= MINIMUM_RELIABLE_VIEWS:
        # Too few to tell which are wrong without their evidence (`few_pairs`).
        all_pairs = _solved(T, C, np.arange(len(views)), scale)
        is_solved = np.isfinite(all_pairs.cost) or not scale
        return all_pairs.factor if is_solved else _scale_of(T, C), seen
    best = _best_refined(T, C, _likeliest_of_triples(T, C, scale), scale)
    if not np.isfinite(best.cost):
        return _scale_of(T, C) if scale else 1.0, seen
    if best.agree.sum() < max(MIN_AGREEING, MIN_SHARE * len(views)):
        return best.factor, seen
    return best.factor, _mask_of(best, seen)


def likeliest_agreement(
    mount_from_holder: _Matrices,
    camera_from_world: _Matrices,
    seen: Bool[np.ndarray, "views"],
    scale: bool,
) -> tuple[float, Bool[np.ndarray, "views"]] | None:
    """Return the likeliest unit and pairs that agree where others do not, of however few pairs.

    They may agree by chance. Arguments and result are as in `robust_hand_eye`; None if all pairs
    agree, or not most of them, or no more than a solution is made of.
    """
    views = np.flatnonzero(seen)
    T, C = mount_from_holder[views], camera_from_world[views]
    likeliest = _likeliest_of_triples(T, C, scale)
    if likeliest[0].agree.all():
        return None
    best = _best_refined(T, C, likeliest, scale)
    least = max(SOLVED_PAIRS + 1, len(views) // 2 + 1)
    is_found = np.isfinite(best.cost) and least <= best.agree.sum() < len(views)
    return (best.factor, _mask_of(best, seen)) if is_found else None


def _likeliest_of_triples(T: _Matrices, C: _Matrices, scale: bool) -> list["_Solution"]:
    """Return the likeliest solutions that triples of pairs lead to, the best first."""
    solved = _solved_triples(T, C, _triples(len(T)), scale)
    return sorted(solved, key=lambda solution: solution.cost)[:REFINED]


def _best_refined(
    T: _Matrices, C: _Matrices, likeliest: list["_Solution"], scale: bool
) -> "_Solution":
    """Return the likeliest of some solutions after each was solved from all that agree with it."""
    refined = [_refined(T, C, solution, scale) for solution in likeliest]
    return min(refined, key=lambda solution: solution.cost)


def _mask_of(solution: "_Solution", seen: Bool[np.ndarray, "views"]) -> Bool[np.ndarray, "views"]:
    """Return the pairs that agree with a solution of those that were seen, as a mask of all."""
    agree = np.zeros_like(seen)
    agree[np.flatnonzero(seen)[solution.agree]] = True
    return agree


def _refined(T: _Matrices, C: _Matrices, solution: "_Solution", scale: bool) -> "_Solution":
    """Return the solution of all pairs that agree with one, chosen again until they stay."""
    for _ in range(ROUNDS):
        if not np.isfinite(solution.cost) or solution.agree.sum() < 3:
            break
        again = _solved(T, C, np.flatnonzero(solution.agree), scale)
        if again.cost >= solution.cost:
            break
        solution = again
    return solution


def chain_errors(
    measured: Float[np.ndarray, "*batch 4 4"], predicted: Float[np.ndarray, "*batch 4 4"]
) -> Float[np.ndarray, "*batch 2"]:
    """Return distance (m) and angle (rad) between poses."""
    distance = np.linalg.norm(measured[..., :3, 3] - predicted[..., :3, 3], axis=-1)
    return np.stack([distance, host_rotation_angles(measured, predicted)], axis=-1)


def _triples(count: int) -> Int[np.ndarray, "triples 3"]:
    """Return all triples of so many views, or `TRIPLES` of them."""
    if math.comb(count, 3) <= TRIPLES:
        return np.array(list(itertools.combinations(range(count), 3)))
    rng = np.random.default_rng(0)
    return np.array([rng.choice(count, 3, replace=False) for _ in range(TRIPLES)])


class _Solution(NamedTuple):
    """A solution from some pairs.

    Attributes:
        cost: minus the logarithm of its likelihood over all pairs; infinite without a solution.
        factor: metres per unit of the tracker.
        agree: mask of the pairs that agree with it.
    """

    cost: float
    factor: float
    agree: Bool[np.ndarray, "views"]


def _solved_triples(
    T: _Matrices, C: _Matrices, triples: Int[np.ndarray, "triples 3"], scale: bool
) -> list[_Solution]:
    """Return the solutions of many triples of pairs at once, as `_solved` does for one.

    Args:
        T, C: as in `robust_hand_eye`.
        triples: indices of the pairs.
        scale: whether the tracker's unit is unknown.
    """
    robot, tracked = T[triples], C[triples]
    first, second = np.triu_indices(3, 1)
    B, A = (poses[:, second] @ np.linalg.inv(poses)[:, first] for poses in (robot, tracked))
    # As in `hand_eye.park_martin`: the rotation maps the rotation vectors of B to those of A.
    a, b = (host_rotation_vectors(motions) for motions in (A, B))
    rotation = host_nearest_rotation(np.einsum("nki,nkj->nij", a, b))
    # (R_A - 1) t_X + s t_A = R_X t_B, with s = 1 if the unit is known.
    rows, shift = A[..., :3, :3] - np.eye(3), A[..., :3, 3]
    right = np.einsum("nij,nkj->nki", rotation, B[..., :3, 3])
    if scale:
        rows = np.concatenate([rows, shift[..., None]], axis=-1)
    else:
        right = right - shift
    count = len(triples)
    finite = np.asarray(np.isfinite(rotation).all(axis=(1, 2)))
    inverse = np.linalg.pinv(np.where(finite[:, None, None], rows.reshape(count, 9, -1), 0.0))
    solution = (inverse @ right.reshape(count, 9, 1))[..., 0]
    factor = solution[:, 3] if scale else np.ones(count)
    hand = host_poses(rotation, solution[:, :3])
    scaled = np.tile(C, (count, 1, 1, 1))
    scaled[..., :3, 3] *= factor[:, None, None]
    solved = np.isfinite(hand).all(axis=(1, 2)) & (factor > 0.0)
    hand[~solved] = np.eye(4)
    places = np.linalg.inv(hand[:, None] @ robot) @ scaled[np.arange(count)[:, None], triples]
    world = places.mean(axis=1)
    world[:, :3, :3] = host_nearest_rotation(world[:, :3, :3])
    errors = chain_errors(scaled, hand[:, None] @ T @ world[:, None])
    cost, agree = _mixture(errors, _radius(scaled))
    # The likelihood is of positions in the tracker's unit.
    cost = cost - 3.0 * len(T) * np.log(np.where(solved, factor, 1.0))
    cost[~(solved & np.isfinite(cost))] = np.inf
    return [_Solution(*each) for each in zip(cost.tolist(), factor.tolist(), agree, strict=True)]


def _solved(T: _Matrices, C: _Matrices, chosen: np.ndarray, scale: bool) -> _Solution:
    """Return the likeliest of the closed forms' solutions.

    Args:
        T, C: as in `robust_hand_eye`.
        chosen: indices of the pairs that are solved.
        scale: whether the tracker's unit is unknown.
    """
    weights = np.ones(len(chosen))
    results = []
    for form in CLOSED_FORMS.values():
        with np.errstate(all="ignore"):
            hand = _closed_form(form, T[chosen], C[chosen], weights)
            if hand is None:
                continue
            factor = 1.0
            if scale:
                hand[:3, 3], factor = _translation_and_scale(T[chosen], C[chosen], hand[:3, :3])
        scaled = C.copy()
        scaled[:, :3, 3] *= factor
        if not (factor > 0.0 and np.isfinite(hand).all()):
            continue
        world = mean_holder_from_world(hand, T[chosen], scaled[chosen], weights)
        errors = chain_errors(scaled, hand @ T @ world)
        cost, agree = _mixture(errors, _radius(scaled))
        # The likelihood is of positions in the tracker's unit.
        results.append(_Solution(float(cost - 3.0 * len(T) * np.log(factor)), factor, agree))
    nothing = _Solution(np.inf, 1.0, np.ones(len(T), dtype=bool))
    return min(results, key=lambda solution: solution.cost, default=nothing)


def _radius(poses: Float[np.ndarray, "*batch views 4 4"]) -> Float[np.ndarray, "*batch"]:
    """Return the radius of a ball in which positions of this spread are uniform, m."""
    positions = poses[..., :3, 3]
    middle = np.median(positions, axis=-2, keepdims=True)
    spread = np.mean(np.sum((positions - middle) ** 2, axis=-1), axis=-1)
    return np.asarray(np.sqrt(5.0 / 3.0 * spread))


def _mixture(
    errors: Float[np.ndarray, "*batch views 2"], radius: Float[np.ndarray, "*batch"]
) -> tuple[Float[np.ndarray, "*batch"], Bool[np.ndarray, "*batch views"]]:
    """Return the cost of some errors under normal errors of good pairs and wrong pairs anywhere.

    The standard deviations of good pairs and their share are estimated by expectation maximisation.

    Args:
        errors: distance (m) and angle (rad) of each pair; several sets in a batch.
        radius: of the ball in which wrong positions are, m; wrong rotations may be any.

    Returns:
        Minus the logarithm of the posterior density, and which pairs are rather good than wrong.
    """
    usual = np.array([UNIT_TRANSLATION, UNIT_ROTATION])
    ball = 4.0 / 3.0 * np.pi * np.maximum(radius, UNIT_TRANSLATION) ** 3
    wrong = -np.log(ball)[..., None] - np.log(8.0 * np.pi**2)
    # Starting with the better quarter, as if most pairs might be wrong.
    variances = np.maximum(np.quantile(errors, 0.25, axis=-2), 1e-3 * usual) ** 2 / 3.0
    share, cost = np.full(errors.shape[:-2], 0.5), np.full(errors.shape[:-2], np.inf)
    weight = np.ones(errors.shape[:-1])
    for _ in range(MIXTURE_ROUNDS):
        squares = (errors**2 / variances[..., None, :]).sum(axis=-1)
        scale = 1.5 * np.log(2.0 * np.pi * variances).sum(axis=-1)
        good = (np.log(share) - scale)[..., None] - 0.5 * squares
        either = np.logaddexp(good, np.log1p(-share)[..., None] + wrong)
        weight = np.exp(good - either)
        prior = PRIOR_NUMBERS * (usual**2 / variances + np.log(variances)).sum(axis=-1)
        cost = 0.5 * prior - either.sum(axis=-1)
        share = np.clip(weight.mean(axis=-1), 1e-3, 1.0 - 1e-3)
        numbers = 3.0 * weight.sum(axis=-1) + PRIOR_NUMBERS
        squares = np.einsum("...v,...vk->...k", weight, errors**2) + PRIOR_NUMBERS * usual**2
        variances = squares / numbers[..., None]
    return np.asarray(cost), weight > 0.5


def _closed_form(
    form: ClosedForm, T: _Matrices, C: _Matrices, weights: np.ndarray
) -> np.ndarray | None:
    """Return `camera_from_mount` by a closed form; None if the motion does not determine it."""
    try:
        hand, _ = form.of_matrices(T, C, weights)
    except (ValueError, np.linalg.LinAlgError):
        return None
    return hand if np.isfinite(hand).all() else None


def _translation_and_scale(
    T: _Matrices, C: _Matrices, rotation: Float[np.ndarray, "3 3"]
) -> tuple[Float[np.ndarray, "3"], float]:
    """Return the hand-eye translation and the tracker's unit, given the hand-eye rotation."""
    # A X = X B with t_A in the tracker's unit: (R_A - 1) t_X + s t_A = R_X t_B.
    A, B, _ = motion_pairs(T, C, np.ones(len(T)))
    rows = np.concatenate([A[:, :3, :3] - np.eye(3), A[:, :3, 3:]], axis=2).reshape(-1, 4)
    right = (B[:, :3, 3] @ rotation.T).ravel()
    solution = np.linalg.lstsq(rows, right, rcond=None)[0]
    return solution[:3], float(solution[3])


def _scale_of(T: _Matrices, C: _Matrices) -> float:
    """Return a rough unit of the tracker: the ratio of the lengths of both motions."""
    A, B, _ = motion_pairs(T, C, np.ones(len(T)))
    lengths = [np.median(np.linalg.norm(motion[:, :3, 3], axis=1)) for motion in (B, A)]
    return float(lengths[0] / lengths[1]) if lengths[1] > 0.0 else 1.0
