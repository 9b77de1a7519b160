"""Find gross errors before the joint fit, using a free pose for every view instead of the robot's.

With a free pose, an outlying point stands out by itself, because the view's other points hold its
pose, whatever the robot reported. The poses are fitted with a robust loss, and points beyond a
chi-square gate around them are left out; then views whose pose is inconsistent with one hand-eye
transform for all. Smaller disagreement can only be judged with the variance components
(`influence.py`).
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..calibration import Calibration, mount_from_holder
from ..compilation import compiled
from ..dataset import Dataset, Observations
from ..engine import (
    Cauchy,
    JointProblem,
    Noise,
    Prior,
    Step,
    StructuredLM,
    build_problem,
    robust_variance,
    solve,
    without_robot,
)
from ..fit_result import Rejection
from ..staged import agreeing_views, locate_views, median_deviation
from ..variance import FINEST

GROSS = 144.0
"""The squared whitened residual from a view's own best pose beyond which a point is left out.

It is far above the gate of the fit itself. With that gate one corner in sixty of a good real data
set would be rejected; with half of this value, corners of an image whose lens is slightly more
complex than its model.
"""

ROUNDS = 8
"""The largest number of fits, each with the pixel sigma estimated from the one before."""

SETTLED = 0.9
"""The ratio of successive pixel sigmas above which further fits are not worth while."""

ASTRAY, PIXELS_ASTRAY = 10.0, 20.0
"""The median residual of a view under the start's chain above which its pose is located anew.

The first is in units of the median view's, the second in px; both must be exceeded.
"""

MOST = 0.5
"""The fraction of a view's points outside the gate above which the whole view is left out."""

ROUGHLY = StructuredLM(rtol=1e-3)
"""The solver of the screening fits, with a loose tolerance.

Poses at which the cost changes by a thousandth identify distant points just as well.
"""


def screened(
    data: Dataset,
    start: Calibration,
    fixed: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    progress: Callable[[str], None] | None = None,
) -> tuple[Dataset, tuple[Rejection, ...]]:
    """Return the data without gross outliers and without views that contradict the others.

    Args:
        data: the data; what is left out is hidden, not deleted, and a whole view's reason is in
            `masked_views`.
        start: as for `fit_joint`; views whose chain is far off are located anew.
        fixed: as for `fit_joint`; paths outside the camera are ignored here.
        priors: as for `fit_joint`; paths outside the camera are ignored here.
        progress: called with a line of text on what is left out.

    Returns:
        The data, and view id, point and reason of the points left out one by one.
    """
    placed = np.isin(np.arange(data.view_count), data.usable_views())
    if placed.sum() < 3:
        return data, ()
    poses, lost = _start_poses(data, start, placed)
    used = without_views(data, lost)
    sigma, deviations, poses = _robust_poses(used, start, poses, fixed, priors)
    visible = np.asarray(used.visible)
    # Gate on squared whitened residuals: |r|^2 > GROSS sigma^2.
    outside = visible & (deviations > np.sqrt(GROSS) * sigma)
    count, out = visible.sum(axis=1), outside.sum(axis=1)
    wrong = {
        int(k): f"no pose fits it: {out[k]} of its {count[k]} points lie apart"
        for k in np.flatnonzero(out > MOST * count)
    }
    # Four points are the fewest that determine a pose.
    sound = (count >= 4) & ~np.isin(np.arange(len(count)), list(wrong))
    robot = mount_from_holder(data.mount, data.base_from_tool)
    wrong |= agreeing_views(
        robot,
        poses,
        jnp.asarray(sound, dtype=float),
        lambda eye, world: median_deviation(
            Calibration(start.camera, eye, world, data.mount),
            used.observations,
            jnp.asarray(visible & ~outside),
        ),
        data.view_ids,
    ).words

    # Points of a rejected view are reported with the view, not one by one.
    outside[list(wrong)] = False
    points = tuple(
        Rejection(data.view_ids[view], int(point), _far(float(deviations[view, point]), sigma))
        for view, point in np.argwhere(outside)
    )
    if progress is not None and (points or wrong or lost):
        progress(f"left out: {len(points)} points, {len(wrong) + len(lost)} views")
    kept = dataclasses.replace(used, visible=jnp.asarray(visible & ~outside))
    return without_views(kept, wrong), points


def without_views(data: Dataset, reasons: Mapping[int, str]) -> Dataset:
    """Return the data with these views hidden, by index, with the reason for each."""
    masked = [(data.view_ids[view], text) for view, text in reasons.items()]
    return dataclasses.replace(
        data.without(list(reasons)), masked_views=(*data.masked_views, *masked)
    )


def _far(deviation: float, sigma: float) -> str:
    """Return the reason for rejecting a point, with its residual."""
    return (
        f"{deviation:.1f} px from where its view's own best pose puts it, "
        f"{deviation / sigma:.0f} standard deviations"
    )


def _start_poses(
    data: Dataset, start: Calibration, placed: Bool[np.ndarray, "views"]
) -> tuple[SE3, dict[int, str]]:
    """Return `camera_from_world` of every view, and reasons for views of which no pose was found.

    The pose comes from the chain where that is close; views far off are located from their points.
    """
    chain = start.camera_from_world(data.command)
    deviations = np.asarray(_from_chain(start, data.observations))
    visible = np.asarray(data.visible)
    # The median residual of a view, so that a few outlying points do not make its pose look wrong.
    typical = np.zeros(len(visible))
    for k in np.flatnonzero(visible.any(axis=1)):
        typical[k] = np.median(deviations[k, visible[k]])
    limit = max(ASTRAY * float(np.median(typical[placed])), PIXELS_ASTRAY)
    astray = placed & (typical > limit)
    if not astray.any():
        return chain, {}
    alone = eqx.tree_at(
        lambda o: o.visible, data.observations, data.visible & jnp.asarray(astray)[:, None]
    )
    located = locate_views(alone, start.camera)[0].wxyz_xyz
    found = np.isfinite(np.asarray(located)).all(axis=1)
    lost = {int(k): "no pose was found for it" for k in np.flatnonzero(astray & ~found)}
    taken = jnp.asarray(astray & found)
    return SE3(jnp.where(taken[:, None], located, chain.wxyz_xyz)), lost


def _robust_poses(
    data: Dataset,
    start: Calibration,
    poses: SE3,
    fixed: Sequence[str],
    priors: Mapping[str, Prior] | None,
) -> tuple[float, Float[np.ndarray, "views points"], SE3]:
    """Fit a free pose to every view with a robust loss.

    Returns:
        The pixel sigma, px; every point's residual, px; every view's best pose.
    """
    # Priors and held parameters that concern the robot have no meaning here; those of the camera
    # stay.
    placed, still = without_robot(data, start.camera, poses)
    of_camera = {path: prior for path, prior in (priors or {}).items() if _concerns_camera(path)}
    problem = build_problem(
        placed,
        still,
        noise=Noise(1.0, np.inf, np.inf),
        loss=Cauchy(),
        fixed=(*still.transform_names, *filter(_concerns_camera, fixed)),
        priors=of_camera,
    ).problem
    z = problem.start()
    squares, variance = _measured(problem, z)
    for _ in range(ROUNDS):
        sigma = max(float(np.sqrt(variance)), FINEST)
        weighed = eqx.tree_at(lambda p: p.pixel_sigma, problem, jnp.asarray(sigma))
        # Cauchy's loss has the scale sigma, and sigma is estimated from the residuals under it:
        # alternate until sigma falls by less than a tenth.
        z = solve(weighed, ROUGHLY, start=z)[0].z
        squares, variance = _measured(problem, z)
        if variance > (SETTLED * sigma) ** 2:
            break
    found = SE3.exp(z.corrections) @ poses
    return max(float(np.sqrt(variance)), FINEST), np.sqrt(squares), found


def _concerns_camera(path: str) -> bool:
    """Return whether a path is one of the camera's."""
    return path.split(".")[0] == "camera"


@compiled
def _measured(
    problem: JointProblem, z: Step
) -> tuple[Float[Array, "views points"], Float[Array, ""]]:
    """Return every point's squared whitened residual, and their robust variance."""
    squares = problem.squares(z)
    return squares, robust_variance(squares, problem.observations.visible)


@compiled
def _from_chain(start: Calibration, observations: Observations) -> Float[Array, "views points"]:
    """Return every point's residual under the chain, px; infinite where it cannot be projected."""

    def view(seen: Observations) -> Float[Array, "points"]:
        predicted, valid = start.project(seen.command, seen.points)
        distance = jnp.linalg.norm(seen.residuals(predicted, valid), axis=-1)
        return jnp.where(valid, distance, jnp.inf)

    # View by view: a projection of all observations at once takes several times the data's memory.
    return jax.lax.map(view, observations)
