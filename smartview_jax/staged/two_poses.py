"""Let the robot's motion choose between the two poses that each view of a small flat target has.

A single tag seen from afar has two poses in each view (`planar_poses.py`), and in many views the
wrong one leaves less. One hand-eye transform explains the right poses of all views, and wrong ones
only by chance:

1. Transforms are computed from three views at a time, with either pose of each, and those are kept
   that predict the points of all views best.
2. They are refined on the points of all views by a robust search; what a person knows of the
   transforms is refined in the same way, and then decides.
3. Each view gets the pose that is nearer to what the transforms predict.

Where another pair of transforms explains the pictures about as well, that is said.
"""

from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..cameras import Camera
from ..data_checks import MAX_MISFIT_RATIO, MAX_REJECTED_FRACTION
from ..dataset import MINIMUM_RELIABLE_VIEWS, Observations, coplanar, extents
from ..geometry import (
    host_matrices,
    host_rotation_angles,
    host_transformed,
    host_transforms,
    vector_text,
)
from .planar_poses import MIN_DEPTH, Sight, mirrored_poses, refined_poses
from .pose_search import (
    MAX_SQUARE,
    MIN_PLAIN_VIEWS,
    Matrices,
    Transforms,
    nearer_poses,
    ranked_hand_eyes,
    ranked_transforms,
    spaced_views,
    squared_distances,
)
from .weng import unprojected

MAX_ASKED_POINTS = 16
"""The number of points of a view by which it is asked first whether it is ambiguous."""

STEPS_TO_ASK = 8
"""The number of steps from the mirrored pose by which it is asked: a small target needs three, and
with a large one the other pose leaves far too much anyway."""

MAX_SEPARATION = 5.0
"""How plainly a view tells its poses apart, in standard deviations, below which the robot is asked.

Noise makes the wrong pose look better as often as a normal number exceeds this: once in three
million views."""

MIN_PIXEL_SIGMA = 1e-6
"""The least noise, px, that a few views are said to have."""

RIVAL_DEVIANCE = 2.0 * np.log(1e3)
"""The difference of -2 log of the likelihood up to which a rival answer is named: it is then more
likely than one in a thousand."""

EXPLAINED_SHARE = 0.1
"""The share of the target's size in the picture, up to which its points are where the transforms
put them: with any other pose of the target they would be off by more than half of its size."""

MIN_EXPLAINED_VIEWS = 1.0 - MAX_REJECTED_FRACTION
"""The smallest share of the views whose points have to be there; the others are left out."""


class PoseChoice(NamedTuple):
    """The poses that agree with the robot's motion.

    Attributes:
        camera_from_world: of every view.
        exchanged: indices of the views whose other pose was taken.
        explained: whether one pair of transforms predicts the points of nearly all views to a
            small part of the target's own size: robot and camera then move alike, however uncertain
            the poses of single views are.
        outlying: by view index, why its pose in the robot's file cannot be its own; empty where too
            many views are off for that.
        warning: a sentence if another answer explains the pictures about as well, else empty.
    """

    camera_from_world: SE3
    exchanged: tuple[int, ...]
    explained: bool
    outlying: dict[int, str]
    warning: str


def choose_poses(
    observations: Observations,
    camera: Camera,
    camera_from_world: SE3,
    mount_from_holder: SE3,
    used: np.ndarray,
    pixel_sigma: float,
    start: tuple[SE3 | None, SE3 | None] = (None, None),
) -> PoseChoice | None:
    """Return the poses that the robot's motion chooses; None where every view tells its own.

    Args:
        observations: points and pixels.
        camera: the common camera.
        camera_from_world: the pose of each view that leaves least.
        mount_from_holder: the robot's part of the chain.
        used: mask of the views to use.
        pixel_sigma: standard deviation of u and v, px.
        start: hand-eye and world transform as far as they are known; they decide where given.
    """
    views = np.flatnonzero(used)
    poses = host_matrices(camera_from_world)[views]
    robot = host_matrices(mount_from_holder)[views]
    points, seen = np.asarray(observations.points)[views], np.asarray(observations.visible)[views]
    flat = coplanar(extents(points, seen))
    if len(views) < 3 or not flat.any() or not np.isfinite(poses).all():
        return None
    alpha = float(np.sqrt(float(camera.alpha_u) * float(camera.alpha_v)))
    sigma = pixel_sigma / alpha
    if not _may_be_ambiguous(poses, points, seen, flat, sigma):
        return None
    candidates, asked, sight = _both_poses(observations, camera, poses, views, sigma)
    known = tuple(None if pose is None else host_matrices(pose) for pose in start)
    plain = np.flatnonzero(~asked)
    searched = np.arange(len(views)) if len(plain) < MIN_PLAIN_VIEWS else spaced_views(plain)
    ranked = ranked_transforms(
        candidates[:, searched],
        robot[searched],
        Sight(*(part[searched] for part in sight)),
        sigma,
        (known[0], known[1]),
    )
    best = ranked[0]
    chosen = nearer_poses(candidates, best.camera @ robot @ best.world)
    exchanged = views[(chosen == 1) & asked]
    numbers = np.array(camera_from_world.wxyz_xyz)
    distances = _distances(best, robot, sight)
    taken = candidates[chosen, np.arange(len(views))]
    numbers[views] = np.asarray(host_transforms(taken).wxyz_xyz)
    return PoseChoice(
        SE3(numbers),  # pyright: ignore[reportArgumentType]
        tuple(int(view) for view in exchanged),
        bool(np.mean(distances < EXPLAINED_SHARE * _angular_size(sight)) >= MIN_EXPLAINED_VIEWS),
        {int(views[k]): text for k, text in _outlying(best, distances, alpha).items()},
        _rival_warning(
            ranked,
            alpha,
            "Say roughly which (start=), tilt the target more, or use a larger one",
        ),
    )


def hand_eye_at_target(
    observations: Observations,
    camera: Camera,
    camera_from_world: SE3,
    robot: Matrices,
    used: np.ndarray,
    pixel_sigma: float,
    holder_from_world: Float[np.ndarray, "4 4"],
) -> tuple[Float[np.ndarray, "2 used 4 4"], Float[np.ndarray, "4 4"], str]:
    """Return the hand-eye transform that explains a few views of a target whose place is known.

    Args:
        observations, camera, camera_from_world, used, pixel_sigma: as for `choose_poses`.
        robot: `mount_from_holder` of the views to use.
        holder_from_world: pose of the target.

    Returns:
        Both poses of each view to use, equal where it tells its own; the transform; and a sentence
        if another one explains the views about as well, else an empty text.
    """
    views = np.flatnonzero(used)
    alpha = float(np.sqrt(float(camera.alpha_u) * float(camera.alpha_v)))
    # Exact pixels would leave a logarithm of zero.
    sigma = max(pixel_sigma, MIN_PIXEL_SIGMA) / alpha
    poses = host_matrices(camera_from_world)[views]
    candidates, _, sight = _both_poses(observations, camera, poses, views, sigma)
    tried = (candidates @ np.linalg.inv(robot @ holder_from_world)).reshape(-1, 4, 4)
    ranked = ranked_hand_eyes(tried, robot, holder_from_world, sight, sigma)
    advice = "Take another view in which the target is tilted more"
    return candidates, ranked[0].camera, _rival_warning(ranked, alpha, advice)


def _both_poses(
    observations: Observations, camera: Camera, poses: Matrices, views: np.ndarray, sigma: float
) -> tuple[Float[np.ndarray, "2 views 4 4"], np.ndarray, Sight]:
    """Return both poses of some views, which of them are ambiguous, and their points.

    Both are equal where a view is not ambiguous.
    """
    points, seen = np.asarray(observations.points)[views], np.asarray(observations.visible)[views]
    rays, valid = unprojected(observations, camera)
    flat, seen = coplanar(extents(points, seen)), seen & valid[views]
    sight = Sight(points, np.where(seen[..., None], rays[views], 0.0), seen)
    first, _ = refined_poses(poses, sight)
    second, _ = refined_poses(mirrored_poses(first, sight), sight)
    asked = flat & _is_ambiguous(first, points, seen, flat, sigma)
    return np.stack([first, np.where(asked[:, None, None], second, first)]), asked, sight


def _may_be_ambiguous(
    poses: Matrices,
    points: Float[np.ndarray, "views points 3"],
    seen: np.ndarray,
    flat: np.ndarray,
    sigma: float,
) -> bool:
    """Return whether any view may be ambiguous, by some of its points where it has many."""
    count = points.shape[1]
    some = np.sort(np.random.default_rng(0).permutation(count)[:MAX_ASKED_POINTS])
    part = seen[:, some]
    if count > len(some) and (part.sum(axis=1) * 2 > len(some)).all():
        # Fewer points leave less, in proportion.
        sigma = sigma * float(np.sqrt(len(some) / count))
        points, seen = points[:, some], part
    return bool(_is_ambiguous(poses, points, seen, flat, sigma).any())


def _is_ambiguous(
    poses: Matrices,
    points: Float[np.ndarray, "views points 3"],
    seen: np.ndarray,
    flat: np.ndarray,
    sigma: float,
) -> np.ndarray:
    """Return which views would often leave less with the other pose, at a noise of the rays."""
    p = host_transformed(poses, points)
    seen = seen & flat[:, None] & (p[..., 2] > MIN_DEPTH)
    # What an exact view of the first pose leaves with the second one: with noise, the difference
    # of the sums of squares varies by twice its root.
    rays = np.where(seen[..., None], p[..., :2] / np.maximum(p[..., 2:], MIN_DEPTH), 0.0)
    exact = Sight(points, rays, seen)
    other, misfit = refined_poses(mirrored_poses(poses, exact), exact, STEPS_TO_ASK)
    return (
        flat
        & (np.sqrt(misfit) < 2.0 * MAX_SEPARATION * sigma)
        & (host_rotation_angles(other, poses) > 1e-3)
    )


def _distances(best: Transforms, robot: Matrices, sight: Sight) -> Float[np.ndarray, "views"]:
    """Return how far the points of each view are from where transforms put them, RMS, as rays."""
    squares = np.minimum(
        squared_distances(best.camera[None], robot, best.world[None], sight)[0], MAX_SQUARE
    )
    return np.sqrt(np.sum(squares, axis=1) / np.maximum(sight.seen.sum(axis=1), 1))


def _outlying(
    best: Transforms, distance: Float[np.ndarray, "views"], alpha: float
) -> dict[int, str]:
    """Return the views whose points are not where the best transforms put them, and how far off."""
    off = np.flatnonzero(distance > MAX_MISFIT_RATIO * best.scale)
    if len(distance) < MINIMUM_RELIABLE_VIEWS or len(off) > MAX_REJECTED_FRACTION * len(distance):
        return {}
    usual = f"{alpha * best.scale:.2g} px in the usual view: mispaired or moved?"
    return {
        int(k): f"its points lie {px:.0f} px from where the robot's pose puts them, {usual}"
        for k, px in zip(off, alpha * distance[off], strict=True)
    }


def _angular_size(sight: Sight) -> float:
    """Return the median distance of the points from their middle in a view, as rays."""
    count = np.maximum(sight.seen.sum(axis=1), 1)[:, None]
    middle = np.sum(sight.rays, axis=1) / count
    distance = np.linalg.norm(sight.rays - middle[:, None], axis=-1)
    return float(np.median(distance[sight.seen]))


def _rival_warning(ranked: list[Transforms], alpha: float, advice: str) -> str:
    """Return a sentence if another answer explains the pictures about as well as the first.

    It ends with the advice.
    """
    best = ranked[0]
    rivals = [pair for pair in ranked[1:] if pair.deviance - best.deviance < RIVAL_DEVIANCE]
    if not rivals:
        return ""
    rival = min(rivals, key=lambda pair: pair.deviance)
    place, other = (1e3 * pair.camera[:3, 3] for pair in (best, rival))
    numbers = [vector_text(values, 0) for values in (place, other)]
    return (
        "a small flat target has two poses in every view, and two answers explain the pictures "
        f"about as well: hand-eye translations {numbers[0]} mm, which leaves "
        f"{alpha * best.scale:.2f} px, and {numbers[1]} mm, which leaves "
        f"{alpha * rival.scale:.2f} px. {advice}"
    )
