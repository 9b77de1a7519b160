"""Search for the hand-eye and world transform that explain views with two poses each.

Transforms are computed from three views at a time, with either pose of each, or, where the robot's
motion leaves directions open, from random choices of poses. Those that predict the points of the
views best are refined on all points by a robust search.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..dataset import evenly_spaced, undetermined_twists
from ..geometry import (
    host_adjoints,
    host_exponentials,
    host_nearest_rotation,
    host_poses,
    host_rotation_angles,
    host_rotation_vectors,
)
from ..hand_eye import minimum_norm_transforms
from .planar_poses import MIN_DEPTH, Sight, linearised

Matrices = Float[np.ndarray, "views 4 4"]

MAX_TRIPLES, MAX_TRIED_TRIPLES = 250, 3000
"""The number of triples of views that are solved, and of those among which they are chosen.

If half of the views tell their poses badly, a triple of good ones is among 250 in every case."""

MAX_GUESSES, GUESS_ROUNDS = 8, 2
"""The number of random choices of poses where triples tell nothing, and of repetitions of each."""

MAX_SCORED_VIEWS = 60
"""The number of views on which the transforms of triples are scored."""

MAX_REFINED, MAX_ALIKE = 40, 15
"""The number of transforms that are refined, and of the best among them, which may be alike."""

MIN_DIFFERENCE = np.deg2rad(20.0)
"""The angle by which the other transforms differ that are refined: one of the noise of a triple."""

MIN_DAMPING, MAX_DAMPING = 1e-4, 1e4
"""The damping of a step, relative to the diagonal: the first that is tried, and the last."""

MAX_STEPS = 40
"""The largest number of steps of a refinement."""

SAME_ANSWER = np.deg2rad(3.0)
"""The angle between two hand-eye or world rotations up to which they are one answer."""

SCALES = 400
"""The number of scales among which the likeliest is taken."""

POSE_NUMBERS = 6
"""The numbers of a view's pose, which is all that a small target tells of the chain."""

MIN_PLAIN_VIEWS, MAX_PLAIN_TRIPLES, MAX_PLAIN_REFINED = 20, 20, 2
"""The number of views that tell their poses apart from which these alone give the transforms, of
their triples that are solved, and of transforms that are refined: there is nothing to choose."""

MAX_SQUARE = 1.0
"""The square at which the distance of a point from its ray ends to count: 45 degrees."""


class Transforms(NamedTuple):
    """A pair of transforms, and how well it explains the points."""

    camera: Float[np.ndarray, "4 4"]
    world: Float[np.ndarray, "4 4"]
    scale: float
    deviance: float


def ranked_transforms(
    candidates: Float[np.ndarray, "2 views 4 4"],
    robot: Matrices,
    sight: Sight,
    sigma: float,
    start: tuple[Float[np.ndarray, "4 4"] | None, Float[np.ndarray, "4 4"] | None],
) -> list[Transforms]:
    """Return different refined transforms: the start's, if there is one, then the best first."""
    if len(undetermined_twists(robot)):
        cameras, worlds = _minimum_norm_guesses(candidates, robot)
    else:
        cameras, worlds = _triple_transforms(candidates, robot)
    some = spaced_views(np.arange(len(robot)))
    part = Sight(sight.points[some], sight.rays[some], sight.seen[some])
    costs = np.concatenate(
        [
            _robust_cost(
                squared_distances(cameras[k : k + 500], robot[some], worlds[k : k + 500], part),
                sigma,
            )
            for k in range(0, len(cameras), 500)
        ]
    )
    order = np.argsort(np.where(np.isfinite(costs), costs, np.inf), kind="stable")
    first = _different_first(order, cameras, worlds)
    if _is_plain(candidates):
        first = first[:MAX_PLAIN_REFINED]
    refined = [_refined(cameras[k], worlds[k], robot, sight, sigma) for k in first]
    refined.sort(key=lambda pair: pair.deviance)
    if any(pose is not None for pose in start):
        given = [
            _refined(*pair, robot, sight, sigma)
            for pair in _pairs_of_start(start, candidates, robot)
        ]
        refined.insert(0, min(given, key=lambda pair: pair.deviance))
    return _different_answers(refined)


def ranked_hand_eyes(
    cameras: Float[np.ndarray, "many 4 4"],
    robot: Matrices,
    world: Float[np.ndarray, "4 4"],
    sight: Sight,
    sigma: float,
) -> list[Transforms]:
    """Return different hand-eye transforms for a target whose place is known, the best first."""
    squares = squared_distances(cameras, robot, np.broadcast_to(world, cameras.shape), sight)
    answers = [
        Transforms(camera, world, *_scale_and_deviance(of_camera, sight, sigma))
        for camera, of_camera in zip(cameras, squares, strict=True)
    ]
    return _different_answers(sorted(answers, key=lambda pair: pair.deviance))


def _different_answers(ranked: Sequence[Transforms]) -> list[Transforms]:
    """Return the transforms that differ from all before them."""
    different: list[Transforms] = []
    for pair in ranked:
        if not any(_is_same_answer(pair, other) for other in different):
            different.append(pair)
    return different


def _is_plain(candidates: Float[np.ndarray, "2 views 4 4"]) -> bool:
    """Return whether every view tells its own pose."""
    return np.array_equal(candidates[0], candidates[1])


def spaced_views(views: Int[np.ndarray, "views"]) -> Int[np.ndarray, "some"]:
    """Return at most `MAX_SCORED_VIEWS` of the views, at equal distances."""
    return views[evenly_spaced(len(views), MAX_SCORED_VIEWS)]


def _minimum_norm_guesses(
    candidates: Float[np.ndarray, "2 views 4 4"], robot: Matrices
) -> tuple[Float[np.ndarray, "many 4 4"], Float[np.ndarray, "many 4 4"]]:
    """Return transforms for a motion that leaves directions undetermined, which no triple tells.

    They come from the first poses, from the second ones and from random choices, each repeated with
    the poses that are nearer to what it predicts.
    """
    count = len(robot)
    random = np.random.default_rng(0).integers(0, 2, (MAX_GUESSES, count))
    cameras, worlds = [], []
    for choice in (np.zeros(count, int), np.ones(count, int), *random):
        camera, world = minimum_norm_transforms(robot, candidates[choice, np.arange(count)])
        for _ in range(GUESS_ROUNDS):
            nearer = nearer_poses(candidates, camera @ robot @ world)
            camera, world = minimum_norm_transforms(robot, candidates[nearer, np.arange(count)])
        cameras.append(camera)
        worlds.append(world)
    return np.array(cameras), np.array(worlds)


def _different_first(
    order: Int[np.ndarray, "many"],
    cameras: Float[np.ndarray, "many 4 4"],
    worlds: Float[np.ndarray, "many 4 4"],
) -> list[int]:
    """Return the best transforms to refine, most of them different, so that rivals are among them.

    `order` has the indices of the transforms, the best first.
    """
    chosen = [int(k) for k in order[:MAX_ALIKE]]
    for k in order[MAX_ALIKE:]:
        if len(chosen) == MAX_REFINED:
            break
        near = (host_rotation_angles(cameras[chosen], cameras[k][None]) < MIN_DIFFERENCE) & (
            host_rotation_angles(worlds[chosen], worlds[k][None]) < MIN_DIFFERENCE
        )
        if not near.any():
            chosen.append(int(k))
    return chosen


def _triple_transforms(
    candidates: Float[np.ndarray, "2 views 4 4"], robot: Matrices
) -> tuple[Float[np.ndarray, "many 4 4"], Float[np.ndarray, "many 4 4"]]:
    """Return both transforms from well-turned triples of views, with either pose of each view."""
    triples = _triples(robot)
    signs = np.array(list(itertools.product((0, 1), repeat=3)))
    if _is_plain(candidates):
        triples, signs = triples[:MAX_PLAIN_TRIPLES], signs[:1]
    views = np.repeat(triples, len(signs), axis=0)
    C = candidates[np.tile(signs, (len(triples), 1)), views]
    T = robot[views]
    i, j = np.array([0, 0, 1]), np.array([1, 2, 2])
    # A X = X B with A = C_j C_i^-1, B = T_j T_i^-1 and X = camera_from_mount (Park and Martin).
    A, B = C[:, j] @ np.linalg.inv(C[:, i]), T[:, j] @ np.linalg.inv(T[:, i])
    a, b = (host_rotation_vectors(motion) for motion in (A, B))
    R = host_nearest_rotation(a.swapaxes(1, 2) @ b)
    rows = (A[..., :3, :3] - np.eye(3)).reshape(-1, 9, 3)
    right = (B[..., :3, 3] @ R.swapaxes(1, 2) - A[..., :3, 3]).reshape(-1, 9, 1)
    cameras = host_poses(R, (np.linalg.pinv(rows, rcond=1e-3) @ right)[..., 0])
    each = np.linalg.inv(cameras[:, None] @ T) @ C
    rotations = host_nearest_rotation(each[..., :3, :3].mean(axis=1))
    return cameras, host_poses(rotations, each[..., :3, 3].mean(axis=1))


def _triples(robot: Matrices) -> Int[np.ndarray, "triples 3"]:
    """Return triples of views between which the robot turned much about different axes."""
    count = len(robot)
    if count * (count - 1) * (count - 2) // 6 <= MAX_TRIED_TRIPLES:
        triples = np.array(list(itertools.combinations(range(count), 3)))
    else:
        # At random, always alike.
        keys = np.random.default_rng(0).random((MAX_TRIED_TRIPLES, count))
        triples = np.sort(np.argpartition(keys, 3, axis=1)[:, :3], axis=1)
    R = robot[triples][..., :3, :3]
    turns = np.stack(
        [R[:, j] @ R[:, i].swapaxes(1, 2) for i, j in ((0, 1), (0, 2), (1, 2))], axis=1
    )
    second = np.linalg.svd(host_rotation_vectors(turns), compute_uv=False)[:, 1]
    return triples[np.argsort(-second, kind="stable")[:MAX_TRIPLES]]


def _pairs_of_start(
    start: tuple[Float[np.ndarray, "4 4"] | None, Float[np.ndarray, "4 4"] | None],
    candidates: Float[np.ndarray, "2 views 4 4"],
    robot: Matrices,
) -> list[tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"]]]:
    """Return pairs of transforms: one as the start has it, the other from each view and pose."""
    camera, world = start
    if camera is not None and world is not None:
        return [(camera, world)]
    every = candidates.reshape(-1, 4, 4)
    T = np.concatenate([robot, robot])
    if camera is not None:
        return [(camera, other) for other in np.linalg.inv(camera @ T) @ every]
    assert world is not None
    return [(other, world) for other in every @ np.linalg.inv(T @ world)]


def squared_distances(
    cameras: Float[np.ndarray, "many 4 4"],
    robot: Matrices,
    worlds: Float[np.ndarray, "many 4 4"],
    sight: Sight,
) -> Float[np.ndarray, "many views points"]:
    """Return the squared distances of the points from their rays; infinite behind the camera."""
    chain = cameras[:, None] @ robot[None] @ worlds[:, None]
    p = np.einsum("mvab,vpb->mvpa", chain[..., :3, :3], sight.points) + chain[:, :, None, :3, 3]
    in_front = p[..., 2] > MIN_DEPTH
    ideal = p[..., :2] / np.where(in_front, p[..., 2], 1.0)[..., None]
    squares = np.sum((ideal - sight.rays) ** 2, axis=-1)
    return np.where(sight.seen, np.where(in_front, squares, np.inf), 0.0)


def _robust_cost(
    squares: Float[np.ndarray, "many views points"], scale: float
) -> Float[np.ndarray, "many"]:
    """Return the sum of Cauchy's loss."""
    return np.sum(np.log1p(np.minimum(squares, MAX_SQUARE) / scale**2), axis=(1, 2))


def _refined(
    camera: Float[np.ndarray, "4 4"],
    world: Float[np.ndarray, "4 4"],
    robot: Matrices,
    sight: Sight,
    sigma: float,
) -> Transforms:
    """Return transforms at the nearest robust minimum over all points, with their likelihood."""
    scale = sigma
    for _ in range(MAX_STEPS):
        residual, jacobian, squares = _chain_linearised(camera, world, robot, sight)
        finite = sight.seen & np.isfinite(squares)
        if finite.sum() < 6:
            break
        # The scale follows the residuals down, as far as the noise of the pixels.
        median = float(np.median(squares[finite]))
        scale = max(sigma, np.sqrt(median / (2.0 * np.log(2.0))))
        weight = np.where(finite, 1.0 / (1.0 + np.where(finite, squares, 0.0) / scale**2), 0.0)
        weighted = jacobian * weight[..., None, None]
        matrix = np.einsum("vpki,vpkj->ij", weighted, jacobian)
        gradient = np.einsum("vpki,vpk->i", weighted, residual)
        before = after = float(_robust_cost(squares[None], scale)[0])
        damping = MIN_DAMPING
        while damping < MAX_DAMPING and not after < before:
            diagonal = np.maximum(np.diagonal(matrix), 1e-9 * np.diagonal(matrix).max())
            step = -np.linalg.solve(matrix + damping * np.diag(diagonal), gradient)
            trial = camera @ host_exponentials(step[:6]), host_exponentials(step[6:]) @ world
            trial_squares = squared_distances(trial[0][None], robot, trial[1][None], sight)
            after = float(_robust_cost(trial_squares, scale)[0])
            if after < before:
                camera, world = trial
            damping *= 10.0
        if before - after < 1e-6 * before:
            break
    squares = squared_distances(camera[None], robot, world[None], sight)
    return Transforms(camera, world, *_scale_and_deviance(squares[0], sight, sigma))


def _chain_linearised(
    camera: Float[np.ndarray, "4 4"],
    world: Float[np.ndarray, "4 4"],
    robot: Matrices,
    sight: Sight,
) -> tuple[
    Float[np.ndarray, "views points 2"],
    Float[np.ndarray, "views points 2 12"],
    Float[np.ndarray, "views points"],
]:
    """Return residuals, their derivative by a twist at mount and holder, and their squares."""
    residual, jacobian, _ = linearised(camera @ robot @ world, sight)
    # A twist at mount or holder passes to the camera through the transforms left of it.
    jacobian = np.concatenate(
        [jacobian @ host_adjoints(camera), jacobian @ host_adjoints(camera @ robot)], axis=2
    )
    squares = squared_distances(camera[None], robot, world[None], sight)[0]
    shape = (*sight.seen.shape, 2)
    return residual.reshape(shape), jacobian.reshape(*shape, 12), squares


def _scale_and_deviance(
    squares: Float[np.ndarray, "views points"], sight: Sight, sigma: float
) -> tuple[float, float]:
    """Return the typical residual of a view's points and -2 log of the likelihood.

    A robot's error shifts all points of a view together, so a view counts as the numbers of a pose,
    not as its points. Their scale is the one that makes Cauchy's likelihood largest.
    """
    count = np.maximum(sight.seen.sum(axis=1), 1)
    mean = np.minimum(np.sum(squares, axis=1) / count, MAX_SQUARE)
    # Student's t with one degree of freedom for the k numbers of each view, whose squares sum to
    # k / 2 times the mean square of a point: -2 log L = 2 k log s + (k + 1) log(1 + sum / s^2).
    k = POSE_NUMBERS
    scales = np.geomspace(sigma, np.sqrt(MAX_SQUARE), SCALES)[:, None]
    deviances = 2.0 * k * np.log(scales) + (k + 1.0) * np.log1p(0.5 * k * mean / scales**2)
    sums = deviances.sum(axis=1)
    best = int(np.argmin(sums))
    return float(scales[best, 0]), float(sums[best])


def _is_same_answer(answer: Transforms, other: Transforms) -> bool:
    """Return whether two pairs of transforms are one answer."""
    return all(
        host_rotation_angles(first, second) < SAME_ANSWER
        for first, second in ((answer.camera, other.camera), (answer.world, other.world))
    )


def nearer_poses(
    candidates: Float[np.ndarray, "2 views 4 4"], predicted: Matrices
) -> Int[np.ndarray, "views"]:
    """Return which of its two poses is turned less from the predicted one, for every view."""
    return np.argmin([host_rotation_angles(poses, predicted) for poses in candidates], axis=0)
