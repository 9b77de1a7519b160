"""Which views' robot poses and camera poses agree with those of the others: Step 3 takes no others.

A picture that is paired with the wrong pose, or was taken while the robot moved, pulls the
hand-eye transform by its share however far off it is. So the transforms are found again
without the view that fits worst, and if it then stands far out from the rest it is left out, and so
on.
"""

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..compilation import compiled
from ..geometry import mean_pose
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


def agreeing_views(
    mount_from_holder: SE3, camera_from_world: SE3, weights: Float[Array, "views"]
) -> tuple[Bool[np.ndarray, "views"], dict[int, str]]:
    """The views that agree, and in words what is wrong with those that do not.

    Args:
        mount_from_holder: the robot's part of the chain, `(views)`.
        camera_from_world: from the pictures alone, `(views)`.
        weights: zero leaves a view out, without a word.
    """
    given = np.asarray(weights) > 0.0
    kept, words = given.copy(), {}
    away = np.linalg.norm(np.asarray(camera_from_world.translation()), axis=1)
    least = LEAST * np.stack([away, np.ones(len(away))], axis=1)

    def misfits(used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of every view, in m and rad, and as multiples of the median of those used."""
        misfit = np.asarray(_misfit(mount_from_holder, camera_from_world, jnp.asarray(used)))
        return misfit, (misfit / np.maximum(np.median(misfit[used], axis=0), least)).max(axis=1)

    while kept.sum() >= FEWEST and len(words) < AT_MOST * given.sum():
        worst = int(np.argmax(np.where(kept, misfits(kept)[1], 0.0)))
        rest = kept & (np.arange(len(kept)) != worst)
        misfit, times = misfits(rest)
        if not times[worst] > FAR_OUT:
            break
        kept = rest
        words[worst] = (
            f"robot and camera disagree by {np.rad2deg(misfit[worst, 1]):.3g} degrees and "
            f"{1e3 * misfit[worst, 0]:.3g} mm there, {times[worst]:.0f} times as much as in the "
            f"median view: mispaired or moved?"
        )
    return kept, words


@compiled
def _misfit(T: SE3, C: SE3, used: Bool[Array, "views"]) -> Float[Array, "views 2"]:
    """Translation (m) and rotation (rad) at the mount that the transforms leave over."""
    weights = used.astype(float)
    eye, world = park_martin(T, C, weights)
    # Averaged over the views, the error of the one transform cancels in the other.
    eye = mean_pose(C @ (T @ SE3(world.wxyz_xyz[None])).inverse(), weights)
    left = SE3(eye.wxyz_xyz[None]).inverse() @ C @ SE3(world.wxyz_xyz[None]).inverse() @ T.inverse()
    twist = left.log()
    return jnp.linalg.norm(twist.reshape(-1, 2, 3), axis=2)
