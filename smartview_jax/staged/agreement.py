"""Which views' robot poses and camera poses agree with those of the others: Step 3 takes no others.

A picture that is paired with the wrong pose, or was taken while the robot moved, pulls the
hand-eye transform by its share however far off it is. So the transforms are found again
without the view that fits worst, and if it then stands far out from the rest it is left out, and so
on.

A view may also stand out because its own points tell its pose badly: few of them, or all in one
corner of the target. Then the others put them where they are seen: such a view has no say in the
transforms, and nothing is wrong with it.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..calibration import Calibration
from ..compilation import compiled
from ..dataset import Observations, chain_residuals
from ..geometry import host_matrices, mean_pose
from .closed_form import park_martin

FAR_OUT = 10.0
"""Times the median view's misfit, in rotation or in translation, that a robot's own errors do not
reach: on nine real data sets the worst view lies at one to seven times."""

FEWEST = 8
"""Views below which a misfit cannot be laid at one view's door.

Of six sound views of a real data set one lay at fourteen times the others' misfit, which the
transforms had been fitted to; without it the error on an unseen view was six times as large.
"""

AT_MOST = 0.25
"""Share of the views that are left out; more is not a matter of single views."""

LEAST = 1e-3
"""Misfit of a median view at the least, rad and as a share of the distance to the target.

A view may see the target badly, and then its pose is off by a multiple of next to nothing. What is
smaller only the joint fit can judge.
"""

SEEN_THERE = 5.0
"""Times the median view's deviation in px within which the others put a view's points where they
are seen: a wrong pose is off by tens to hundreds of times."""


class Agreement(NamedTuple):
    """Which views agree.

    Attributes:
        kept: the views that Step 3 takes.
        words: by view, what is wrong with those that are not used at all.
        unsure: views whose own pose is off, but whose points are where the others put them.
    """

    kept: Bool[np.ndarray, "views"]
    words: dict[int, str]
    unsure: tuple[int, ...]


def agreeing_views(
    mount_from_holder: SE3,
    camera_from_world: SE3,
    weights: Float[Array, "views"],
    deviation: Callable[[SE3, SE3], Float[np.ndarray, "views"]] | None = None,
    view_ids: Sequence[str] | None = None,
) -> Agreement:
    """Find the views that agree, and say what is wrong with those that do not.

    Args:
        mount_from_holder: the robot's part of the chain, `(views)`.
        camera_from_world: from the pictures alone, `(views)`.
        weights: zero leaves a view out, without a word.
        deviation: of the points of each view, px, from where `camera_from_mount` and
            `holder_from_world` put them; where it is not given, a view's own pose decides.
        view_ids: names for the words; by default numbers.
    """
    given = np.asarray(weights) > 0.0
    ids = [str(k) for k in range(len(given))] if view_ids is None else view_ids
    kept, wrong, unsure = given.copy(), [], []
    away = np.linalg.norm(np.asarray(camera_from_world.wxyz_xyz)[:, 4:], axis=1)
    least = LEAST * np.stack([away, np.ones(len(away))], axis=1)

    def fitted(used: np.ndarray) -> _Fitted:
        """The transforms by some views; misfits of all in m and rad, and in medians of those."""
        eye, world, misfit = _fit(mount_from_holder, camera_from_world, jnp.asarray(used))
        misfit = np.asarray(misfit)
        unit = np.maximum(np.median(misfit[used], axis=0), least)
        return _Fitted(eye, world, misfit, (misfit / unit).max(axis=1), unit)

    while kept.sum() >= FEWEST and len(wrong) + len(unsure) < AT_MOST * given.sum():
        worst = int(np.argmax(np.where(kept, fitted(kept).times, 0.0)))
        rest = kept & (np.arange(len(kept)) != worst)
        found = fitted(rest)
        if not found.times[worst] > FAR_OUT:
            break
        kept = rest
        px = None
        if deviation is not None:
            px = deviation(found.camera_from_mount, found.holder_from_world)
        if px is not None and px[worst] <= SEEN_THERE * np.median(px[rest]):
            unsure.append(worst)
        else:
            wrong.append(worst)
    # In words by the transforms without any of them: of two that were exchanged, one pulls.
    found = fitted(kept)
    px = None if deviation is None else deviation(found.camera_from_mount, found.holder_from_world)
    words = {}
    for view in wrong:
        text = (
            f"robot and camera disagree by {_size(found.misfit[view])} there, "
            f"{found.times[view]:.0f} times as much as in the median view"
        )
        if px is not None:
            where = f"{px[view]:.3g} px off" if np.isfinite(px[view]) else "out of the picture"
            text += f", and its points {where} (the median view's {np.median(px[kept]):.2g} px)"
        whose = _whose(view, found, mount_from_holder, camera_from_world, ids)
        words[view] = f"{text}: {whose}"
    return Agreement(kept, words, tuple(unsure))


def median_deviation(
    calibration: Calibration, observations: Observations, seen: Bool[Array, "views points"]
) -> Float[np.ndarray, "views"]:
    """Median distance of each view's points from where the chain puts them, px.

    Infinite where no point is seen.
    """
    off = np.linalg.norm(np.asarray(chain_residuals(calibration, observations)), axis=2)
    return np.array(
        [
            np.median(distances[used]) if used.any() else np.inf
            for distances, used in zip(off, np.asarray(seen), strict=True)
        ]
    )


class _Fitted(NamedTuple):
    """Transforms by some of the views, and how all views fit them."""

    camera_from_mount: SE3
    holder_from_world: SE3
    misfit: Float[np.ndarray, "views 2"]
    times: Float[np.ndarray, "views"]
    unit: Float[np.ndarray, "views 2"]


def _size(misfit: Float[np.ndarray, "2"]) -> str:
    return f"{np.rad2deg(misfit[1]):.3g} degrees and {1e3 * misfit[0]:.3g} mm"


def _whose(
    view: int,
    found: _Fitted,
    mount_from_holder: SE3,
    camera_from_world: SE3,
    ids: Sequence[str],
) -> str:
    """The pose of another view that the picture fits; if there is none, that it may have moved."""
    robot, camera = (host_matrices(p) for p in (mount_from_holder, camera_from_world))
    eye, world = (host_matrices(p) for p in (found.camera_from_mount, found.holder_from_world))
    # Where the mount would have to be in the holder's frame for this picture.
    wanted = np.linalg.inv(eye) @ camera[view] @ np.linalg.inv(world)
    offset = wanted @ np.linalg.inv(robot)
    turn = np.arccos(np.clip(0.5 * (np.trace(offset[:, :3, :3], axis1=1, axis2=2) - 1.0), -1, 1))
    shift = np.linalg.norm(offset[:, :3, 3], axis=1)
    misfit = np.stack([shift, turn], axis=1)
    times = np.where(np.arange(len(robot)) == view, np.inf, (misfit / found.unit).max(axis=1))
    other = int(np.argmin(times))
    if times[other] < FAR_OUT:
        return f"it fits the pose of view {ids[other]} ({_size(misfit[other])}): mispaired"
    return "it fits the pose of no other view either: moved, or a wrong pose?"


@compiled
def _fit(T: SE3, C: SE3, used: Bool[Array, "views"]) -> tuple[SE3, SE3, Float[Array, "views 2"]]:
    """Both transforms, and translation (m) and rotation (rad) at the mount that they leave over."""
    weights = used.astype(float)
    eye, world = park_martin(T, C, weights)
    # Averaged over the views, the error of the one transform cancels in the other.
    eye = mean_pose(C @ (T @ SE3(world.wxyz_xyz[None])).inverse(), weights)
    left = SE3(eye.wxyz_xyz[None]).inverse() @ C @ SE3(world.wxyz_xyz[None]).inverse() @ T.inverse()
    twist = left.log()
    return eye, world, jnp.linalg.norm(twist.reshape(-1, 2, 3), axis=2)
