"""Calibrate every view by itself, by Weng's two-step method (Step 1 of the paper, Eq. 8).

The first of Weng's steps is linear (`weng_start.py`); the second alternates between distortion
and all other unknowns (`weng_alternation.py`).

The linear start needs points that are not in one plane. From a single plane the principal point
cannot be separated from the pose: u0, v0 are then held at the picture's centre and
alpha_u = alpha_v is computed from the homography. A frontal view of a plane does not determine
alpha either and takes the median alpha of the other views.

Reference: Weng, Cohen, Herniou, PAMI 14(10), 1992.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..cameras import Camera
from ..compilation import compiled
from ..dataset import Observations
from .weng_alternation import Found, alternate
from .weng_start import Intrinsics, Start, coplanar, extents, linear_start, planar_start

LINEAR, PLANAR, MEDIAN, NONE = (
    "linear",
    "one plane: centre held, alpha_u = alpha_v",
    "frontal: alpha of the other views",
    "none",
)
"""Names of the linear starts, reported in `ViewCalibrations.starts`."""

_DETERMINED = 0.03
"""Largest relative standard deviation of alpha at which a view counts as determining it."""
_COLLINEAR = 1e-3
"""Ratio of second to largest extent of the points below which they count as one line."""


class ViewCalibrations(eqx.Module):
    """The result of Step 1: one set of intrinsics and one pose for each view.

    Attributes:
        intrinsics: the view's own; `starts` says which of them were held fixed.
        camera_from_world: the view's pose.
        rms: root mean square reprojection error over the points used, px.
        alpha_std: relative standard deviation of alpha in that view.
        used: the points that were not rejected as gross errors.
        starts: name of the start used for each view.
        problems: why a view could not be calibrated; empty where it could.
    """

    intrinsics: Intrinsics
    camera_from_world: SE3
    rms: Float[Array, "views"]
    alpha_std: Float[Array, "views"]
    used: Bool[Array, "views points"]
    starts: tuple[str, ...] = eqx.field(static=True)
    problems: tuple[str, ...] = eqx.field(static=True)

    @property
    def usable(self) -> np.ndarray:
        """The mask `(views,)` of views that could be calibrated."""
        return np.array([not problem for problem in self.problems])

    def camera(self, view: int, image_size: tuple[int, int]) -> Camera:
        """Return the camera with the intrinsics of one view."""
        return Intrinsics(*(value[view] for value in self.intrinsics)).camera(image_size)


def calibrate_views(
    observations: Observations, image_size: tuple[int, int], distortion: bool = True
) -> ViewCalibrations:
    """Calibrate every view by itself.

    Args:
        observations: a view needs 6 visible points, or 4 if they lie in one plane. A view that
            cannot be calibrated is reported in `problems`; its numbers are meaningless.
        image_size: width and height, px.
        distortion: estimate k1; False holds it at zero.
    """
    centre = (np.array(image_size, dtype=float) - 1.0) / 2.0
    extent = np.asarray(extents(observations.points, observations.visible))
    flat = np.asarray(coplanar(jnp.asarray(extent)))
    problems = _too_little(np.asarray(observations.visible).sum(axis=1), extent, flat)
    size = jnp.asarray(float(max(image_size)))
    # Both linear starts are computed for every view and one is selected: the shapes stay fixed.
    start = _starts(observations, jnp.asarray(centre), size, jnp.asarray(flat))
    # One plane: only alpha (and k1) are free; alpha_v / alpha_u, u0 and v0 are held.
    free = np.ones((len(flat), 5), dtype=bool)
    free[flat, 1:4] = False
    free[:, 4] = distortion
    found = _calibrate_all(observations, start, jnp.asarray(free), jnp.asarray(flat))

    alpha_std = found.alpha_std
    usable = np.array([not problem for problem in problems]) & np.isfinite(np.asarray(found.rms))
    frontal = usable & ~(np.asarray(alpha_std) < _DETERMINED)
    if frontal.any():
        # Focal length and distance are exchangeable in a frontal view of a plane. Fit its pose
        # again with the median intrinsics, or its focal length would be arbitrary.
        median = _median(found, usable, frontal)
        held = _hold_alpha(start, median, jnp.asarray(frontal), jnp.asarray(centre))
        free[:, :4] = False
        again = _calibrate_all(
            _only(observations, frontal), held, jnp.asarray(free), jnp.asarray(flat)
        )
        found = _where(jnp.asarray(frontal), again, found)
    starts = tuple(
        NONE if not ok else MEDIAN if far else PLANAR if plane else LINEAR
        for ok, far, plane in zip(usable, frontal, flat, strict=True)
    )
    lost = ~np.isfinite(np.asarray(found.rms))
    problems = tuple(
        text or ("the calibration diverged" if gone else "")
        for text, gone in zip(problems, lost, strict=True)
    )
    return ViewCalibrations(
        found.intrinsics,
        found.camera_from_world,
        found.rms,
        alpha_std,
        found.used,
        starts,
        problems,
    )


def locate_views(
    observations: Observations, camera: Camera
) -> tuple[SE3, Float[Array, "views"], Bool[Array, "views points"]]:
    """Compute the pose of every view for a known camera.

    Distortion is removed from the pixels first (the inverse pinhole map, Eq. 4, after
    undistortion, Eq. 3 for the paper's lens), so any lens can be used.

    Returns:
        `camera_from_world`, the RMS reprojection error of each view in px, and the points used.
    """
    # Unseen pixels are NaN; they are set to zero here and stay masked.
    pixels = jnp.where(observations.visible[..., None], observations.pixels, 0.0)
    rays, valid = camera.unproject(pixels)
    valid = valid & (rays[..., 2] > 1e-3)
    rays = jnp.where(valid[..., None], rays, 1.0)
    straight = Observations(
        observations.points,
        camera.alpha_u * rays[..., :2] / rays[..., 2:],
        observations.visible & valid,
        observations.base_from_tool,
    )
    flat = coplanar(extents(straight.points, straight.visible))
    every = jnp.ones(len(flat), dtype=bool)
    alpha, zero = camera.alpha_u, jnp.zeros(())
    # Undistorted pixels relative to the principal point: an ideal pinhole camera with known alpha.
    known = Intrinsics(alpha, alpha, zero, zero, zero)
    size = jnp.asarray(float(max(camera.image_size)))
    start = _starts(straight, jnp.zeros(2), size, flat)
    held = _hold_alpha(start, known, every, jnp.zeros(2))
    nothing = jnp.zeros((len(flat), 5), dtype=bool)
    found = _calibrate_all(straight, held, nothing, flat)
    return found.camera_from_world, found.rms, found.used


def _too_little(seen: np.ndarray, extent: np.ndarray, flat: np.ndarray) -> tuple[str, ...]:
    """Return for every view why it shows too few points, or an empty text if it does not."""
    problems = []
    for count, (_, second, largest), plane in zip(seen, extent, flat, strict=True):
        needed = 4 if plane else 6
        if count < needed:
            where = "in one plane" if plane else "in space"
            problems.append(f"{count} points seen, {needed} {where} needed")
        elif second < _COLLINEAR * largest:
            problems.append(f"the {count} points seen lie on one line")
        else:
            problems.append("")
    return tuple(problems)


def _only(observations: Observations, views: np.ndarray) -> Observations:
    """Return the observations with all other views masked out; shapes stay as compiled."""
    visible = observations.visible & jnp.asarray(views)[:, None]
    return eqx.tree_at(lambda o: o.visible, observations, visible)


@compiled
def _where(views: Array, one: Found, other: Found) -> Found:
    """Return the first result in the given views and the second result in all others."""

    def pick(a, b):
        return jnp.where(views.reshape((-1,) + (1,) * (a.ndim - 1)), a, b)

    return jax.tree.map(pick, one, other)


def _median(found: Found, usable: np.ndarray, frontal: np.ndarray) -> Intrinsics:
    """Return the median intrinsics over the views that determine alpha."""
    trusted = usable & ~frontal
    if not trusted.any():
        # With no oblique view at all, use the half with the smallest uncertainty.
        alpha_std = np.asarray(found.alpha_std)
        trusted = usable & (alpha_std <= np.median(alpha_std[usable]))
    return jax.tree.map(lambda x: jnp.asarray(np.median(np.asarray(x)[trusted])), found.intrinsics)


@compiled
def _hold_alpha(start: Start, median: Intrinsics, chosen: Array, centre: Array) -> Start:
    """Return the starts with the median intrinsics in the chosen views, depths rescaled to match.

    The size in the picture is alpha / depth, so depth is multiplied by the ratio of the alphas.
    """
    ratio = median.alpha_u / start.intrinsics.alpha_u
    held = Intrinsics(median.alpha_u, median.alpha_u, centre[0], centre[1], median.k1)
    intrinsics = jax.tree.map(
        lambda value, new: jnp.where(chosen, jnp.full_like(value, new), value),
        start.intrinsics,
        held,
    )
    depth = start.poses.wxyz_xyz[..., 6] * jnp.where(chosen, ratio, 1.0)[:, None]
    return Start(intrinsics, SE3(start.poses.wxyz_xyz.at[..., 6].set(depth)))


@compiled
def _starts(observations: Observations, centre: Array, size: Array, flat: Array) -> Start:
    """Compute the linear start of every view, for coplanar or for spatial points."""

    def one(points, pixels, visible, planar):
        plane = planar_start(points, pixels, visible, centre, size)
        solid = linear_start(points, pixels, visible)
        return jax.tree.map(lambda a, b: jnp.where(planar, a, b), plane, solid)

    pixels = jnp.where(observations.visible[..., None], observations.pixels, 0.0)
    return jax.vmap(one)(observations.points, pixels, observations.visible, flat)


@compiled
def _calibrate_all(
    observations: Observations,
    start: Start,
    free: Bool[Array, "views 5"],
    flat: Bool[Array, "views"],
) -> Found:
    """Fit every view from its two start poses and keep the one with the smaller RMS error.

    The two differ for coplanar points only: a small plane has two poses that look almost alike.
    """
    pixels = jnp.where(observations.visible[..., None], observations.pixels, 0.0)

    def one(view):
        # `lax.map`, not `vmap`: each view stops when it has converged. Under `vmap` every view
        # would iterate until the slowest has finished.
        points, pixels, visible, intrinsics, poses, free, planar = view

        def from_pose(which):
            """Fit the view from one of its two start poses."""
            # Spatial points have one pose only; the second fit gets no points and ends at once.
            seen = visible & (planar | (which == 0))
            return alternate(points, pixels, seen, intrinsics, SE3(poses[which]), free)

        both = jax.lax.map(from_pose, jnp.arange(2))
        sound = jnp.isfinite(both.rms) & jnp.stack([jnp.asarray(True), planar])
        best = jnp.argmin(jnp.where(sound, both.rms, jnp.inf))
        return jax.tree.map(lambda x: x[best], both)

    return jax.lax.map(
        one,
        (
            observations.points,
            pixels,
            observations.visible,
            start.intrinsics,
            start.poses.wxyz_xyz,
            free,
            flat,
        ),
    )
