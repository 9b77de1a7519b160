"""Find which pairs of a robot pose and a tracked pose agree, before any fit.

Closed forms are solved on triples of pairs, drawn at random, and the solution with the least median
error over all pairs is kept (least median of squares; Rousseeuw, 1984). It is right as long as more
than half of the pairs are.
"""

import itertools
import math

import numpy as np
from jaxtyping import Bool, Float

from ..dataset import MINIMUM_RELIABLE_VIEWS
from ..geometry import host_logarithms, host_transforms
from ..hand_eye import CLOSED_FORMS, mean_holder_from_world, motion_pairs, park_martin

TRIPLES = 100
"""Number of triples: with a third of all pairs wrong, none is right once in 10^15."""

MAX_ERROR_SIGMAS = 6.0
"""Largest error of a pair that agrees, in standard deviations by the median."""

MEDIAN_OF_NORM = 1.538
"""Median length of a vector of three normal numbers of standard deviation one."""

ROUNDS = 5
"""Largest number of times that the agreeing pairs are solved and chosen again."""

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
        if there are at most `MINIMUM_RELIABLE_VIEWS`, or if the motion does not determine the
        transforms.
    """
    views = np.flatnonzero(seen)
    T, C = mount_from_holder[views], camera_from_world[views]
    if len(views) <= MINIMUM_RELIABLE_VIEWS:
        # Too few to tell which are wrong.
        cost, factor, _ = _solved(T, C, np.arange(len(views)), scale)
        return factor if np.isfinite(cost) or not scale else _scale_of(T, C), seen
    best = min(
        (_solved(T, C, np.array(triple), scale) for triple in _triples(len(views))),
        key=lambda solution: solution[0],
    )
    for _ in range(ROUNDS):
        if not np.isfinite(best[0]):
            return _scale_of(T, C) if scale else 1.0, seen
        again = _solved(T, C, np.flatnonzero(best[2]), scale)
        if not np.isfinite(again[0]) or (again[2] == best[2]).all():
            break
        best = again
    agree = np.zeros_like(seen)
    agree[views[best[2]]] = True
    return best[1], agree


def chain_errors(measured: _Matrices, predicted: _Matrices) -> Float[np.ndarray, "views 2"]:
    """Return distance (m) and angle (rad) between poses."""
    distance = np.linalg.norm(measured[:, :3, 3] - predicted[:, :3, 3], axis=1)
    turn = np.tile(np.eye(4), (len(measured), 1, 1))
    turn[:, :3, :3] = measured[:, :3, :3] @ predicted[:, :3, :3].swapaxes(1, 2)
    return np.stack([distance, np.linalg.norm(host_logarithms(turn)[:, 3:], axis=1)], axis=1)


def _triples(count: int) -> list[tuple[int, ...]]:
    """Return all triples of so many views, or `TRIPLES` of them."""
    if math.comb(count, 3) <= TRIPLES:
        return list(itertools.combinations(range(count), 3))
    rng = np.random.default_rng(0)
    return [tuple(rng.choice(count, 3, replace=False)) for _ in range(TRIPLES)]


def _solved(
    T: _Matrices, C: _Matrices, chosen: np.ndarray, scale: bool
) -> tuple[float, float, Bool[np.ndarray, "views"]]:
    """Return the cost over all pairs, the tracker's unit and the agreeing pairs of a solution.

    Args:
        T, C: as in `robust_hand_eye`.
        chosen: indices of the pairs that are solved.
        scale: whether the tracker's unit is unknown.
    """
    weights = np.ones(len(chosen))
    forms = (park_martin,) if len(chosen) == 3 else tuple(CLOSED_FORMS.values())
    results = []
    for form in forms:
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
        medians = np.median(errors, axis=0)
        # Without a unit that metres and radians have in common, their product is compared.
        cost = float(np.log(np.maximum(medians, 1e-12)).sum())
        limit = MAX_ERROR_SIGMAS / MEDIAN_OF_NORM * np.maximum(medians, 1e-9)
        results.append((cost, factor, (errors <= limit).all(axis=1)))
    return min(results, key=lambda r: r[0], default=(np.inf, 1.0, np.ones(len(T), dtype=bool)))


def _closed_form(form, T: _Matrices, C: _Matrices, weights: np.ndarray) -> np.ndarray | None:
    """Return `camera_from_mount` by a closed form; None if the motion does not determine it."""
    try:
        hand = np.asarray(form(host_transforms(T), host_transforms(C), weights)[0].as_matrix())
    except (ValueError, np.linalg.LinAlgError):
        return None
    return np.array(hand) if np.isfinite(hand).all() else None


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
