"""Find the views whose robot and camera poses agree with those of the others, for use in Step 3.

A picture that is paired with the wrong pose, or was taken while the robot was moving, biases the
hand-eye transform in proportion to its error. Therefore the transforms are computed again without
the view that fits worst; if that view is then an outlier it is left out, and the procedure repeats.

A view may also be an outlier because its own points determine its pose badly: they are few, or all
in one corner of the target. The transforms of the other views then predict its points where they
were seen. Such a view is not used for the transforms, but it is not reported as wrong.
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
"""Limit on a view's misfit in rotation or translation, in multiples of the median view's.

A robot's own errors do not reach it: on nine real data sets the worst view is at one to seven
times."""

FEWEST = 8
"""Smallest number of views with which a misfit can be attributed to a single view.

Of six good views of a real data set one had fourteen times the misfit of the others, to which the
transforms had been fitted; without it the error on an unseen view was six times as large.
"""

AT_MOST = 0.25
"""Largest fraction of the views that is left out; with more the fault is not in single views."""

LEAST = 1e-3
"""Lower bound of the median view's misfit, rad and as a fraction of the distance to the target.

With nearly exact poses, a view that sees the target badly would otherwise be an outlier by a
negligible amount. Smaller misfits are left for the joint fit to judge.
"""

SEEN_THERE = 5.0
"""Reprojection error, in multiples of the median view's, up to which a view's points agree with
the transforms of the others. A wrong pose is at tens to hundreds of times."""


class Agreement(NamedTuple):
    """The result of `agreeing_views`.

    Attributes:
        kept: mask of the views that Step 3 uses.
        words: by view index, what is wrong with the views that are rejected.
        unsure: views with an uncertain pose of their own, whose points agree with the others.
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
    """Find the views that agree, and state what is wrong with the others.

    Args:
        mount_from_holder: the robot's part of the chain, `(views)`.
        camera_from_world: from the pictures alone, `(views)`.
        weights: zero leaves a view out without reporting it.
        deviation: function of `camera_from_mount` and `holder_from_world` that returns the
            reprojection error of each view, px; without it a view's own pose decides.
        view_ids: names of the views in the sentences; by default numbers.
    """
    given = np.asarray(weights) > 0.0
    ids = [str(k) for k in range(len(given))] if view_ids is None else view_ids
    kept, wrong, unsure = given.copy(), [], []
    away = np.linalg.norm(np.asarray(camera_from_world.wxyz_xyz)[:, 4:], axis=1)
    least = LEAST * np.stack([away, np.ones(len(away))], axis=1)

    def fitted(used: np.ndarray) -> _Fitted:
        """Compute the transforms from some views, and the misfits of all views."""
        eye, world, misfit = _fit(mount_from_holder, camera_from_world, jnp.asarray(used))
        misfit = np.asarray(misfit)
        # Misfits are judged relative to the median view, because robots differ in accuracy.
        unit = np.maximum(np.median(misfit[used], axis=0), least)
        return _Fitted(eye, world, misfit, (misfit / unit).max(axis=1), unit)

    # One view per round, judged by transforms computed without it: a wrong view biases the
    # transforms, and then good views may look worse than it does.
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
    # The sentences use transforms without any rejected view: of two exchanged pictures, the
    # second still biased the transforms when the first was rejected.
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
    """Return the median reprojection error of each view through the whole chain, px.

    It is infinite for a view without visible points.
    """
    off = np.linalg.norm(np.asarray(chain_residuals(calibration, observations)), axis=2)
    return np.array(
        [
            np.median(distances[used]) if used.any() else np.inf
            for distances, used in zip(off, np.asarray(seen), strict=True)
        ]
    )


class _Fitted(NamedTuple):
    """The transforms computed from some of the views, and the misfit of every view.

    Attributes:
        camera_from_mount, holder_from_world: the transforms.
        misfit: translation (m) and rotation (rad) of each view.
        times: the larger of the two in multiples of the median view's.
        unit: the median misfit, not below `LEAST`.
    """

    camera_from_mount: SE3
    holder_from_world: SE3
    misfit: Float[np.ndarray, "views 2"]
    times: Float[np.ndarray, "views"]
    unit: Float[np.ndarray, "views 2"]


def _size(misfit: Float[np.ndarray, "2"]) -> str:
    """Return a misfit in words, in degrees and millimetres."""
    return f"{np.rad2deg(misfit[1]):.3g} degrees and {1e3 * misfit[0]:.3g} mm"


def _whose(
    view: int,
    found: _Fitted,
    mount_from_holder: SE3,
    camera_from_world: SE3,
    ids: Sequence[str],
) -> str:
    """Return which other view's pose the picture fits, or that it fits none, in words."""
    robot, camera = (host_matrices(p) for p in (mount_from_holder, camera_from_world))
    eye, world = (host_matrices(p) for p in (found.camera_from_mount, found.holder_from_world))
    # The robot pose that this picture needs, from Eq. 10: T = H^-1 C X^-1.
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
    """Compute both transforms and each view's misfit at the mount: translation (m), rotation (rad).

    The misfit of view i is the twist `log(H^-1 C_i X^-1 T_i^-1)`, zero if Eq. 10 holds exactly.
    """
    weights = used.astype(float)
    eye, world = park_martin(T, C, weights)
    # Recomputing one transform from the other makes their errors cancel in the chain.
    eye = mean_pose(C @ (T @ SE3(world.wxyz_xyz[None])).inverse(), weights)
    left = SE3(eye.wxyz_xyz[None]).inverse() @ C @ SE3(world.wxyz_xyz[None]).inverse() @ T.inverse()
    twist = left.log()
    return eye, world, jnp.linalg.norm(twist.reshape(-1, 2, 3), axis=2)
