"""Calibrate every view by itself, by Weng's two-step method (Step 1 of the paper, Eq. 8).

The first of Weng's steps is linear (`weng_start.py`); the second alternates between distortion
and all other unknowns (`weng_alternation.py`).

The linear start needs points that are not in one plane. From a single plane the principal point
cannot be separated from the pose: u0, v0 are then held at the picture's centre and
alpha_u = alpha_v is computed from the homography. A frontal view of a plane does not determine
alpha either and takes the median alpha of the other views.

Reference: Weng, Cohen, Herniou, PAMI 14(10), 1992.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..cameras import Camera, unit_rays
from ..data_checks import collinear_views
from ..dataset import Observations, coplanar, extents
from ..runtime.array_namespace import to_device
from ..runtime.compilation import compiled_optimised
from ..runtime.modules import HostModule
from ..runtime.padding import MAX_PADDED_OBSERVATIONS, without_padding
from .weng_alternation import ViewFit, fit_view
from .weng_start import Intrinsics, Start, view_starts

# Names of the starts, reported in `ViewCalibrations.starts`.
LINEAR_START = "linear"
PLANAR_START = "one plane: centre held, alpha_u = alpha_v"
MEDIAN_ALPHA_START = "frontal: alpha of the other views"
NO_START = "none"

_VIEWS_IN_BATCH = 8
"""Number of views that one call of the program fits, for small data sets."""

_MAX_ALPHA_RELATIVE_STD = 0.03
"""Largest relative standard deviation of alpha at which a view counts as determining it."""


class ViewCalibrations(HostModule):
    """The result of Step 1: one set of intrinsics and one pose for each view.

    Attributes:
        intrinsics: the view's own; `starts` says which of them were held fixed.
        camera_from_world: the view's pose.
        rms: root mean square reprojection error over the points used, px.
        alpha_relative_std: relative standard deviation of alpha in that view.
        inliers: the points that were not rejected as gross errors.
        starts: name of the start used for each view.
        problems: why a view could not be calibrated; empty where it could.
    """

    intrinsics: Intrinsics
    camera_from_world: SE3
    rms: Float[Array, "views"]
    alpha_relative_std: Float[Array, "views"]
    inliers: Bool[Array, "views points"]
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
    view_count, point_count = observations.visible.shape
    points, pixels, visible = _host_observations(observations.padded())
    centre = (np.array(image_size, dtype=float) - 1.0) / 2.0
    # Whether the points of a view lie in one plane (any plane), which decides how it is started.
    flat = coplanar(extents(points, visible))
    problems = _view_problems(visible.sum(axis=1), collinear_views(points, visible), flat)
    start = view_starts(points, pixels, visible, flat, centre, float(max(image_size)))
    # One plane: only alpha (and k1) are free; alpha_v / alpha_u, u0 and v0 are held.
    free = np.ones((len(flat), 5), dtype=bool)
    free[flat, 1:4] = False
    free[:, 4] = distortion
    view_fits = _fit_all_views(points, pixels, visible, start, free, flat)

    alpha_relative_std = view_fits.alpha_relative_std
    is_finite = np.isfinite(np.asarray(view_fits.rms))
    usable = np.array([not problem for problem in problems]) & is_finite
    frontal = usable & ~(np.asarray(alpha_relative_std) < _MAX_ALPHA_RELATIVE_STD)
    if frontal.any():
        # Focal length and distance are exchangeable in a frontal view of a plane. Fit its pose
        # again with the median intrinsics, or its focal length would be arbitrary.
        median = _median_intrinsics(view_fits, usable, frontal)
        held_start = _hold_intrinsics(start, median, frontal, centre)
        free[:, :4] = False
        # The points of all other views are masked; shapes stay as compiled.
        frontal_only = visible & frontal[:, None]
        refit = _fit_all_views(points, pixels, frontal_only, held_start, free, flat)
        view_fits = _select_by_view(frontal, refit, view_fits)
    starts = tuple(
        NO_START
        if not is_usable
        else MEDIAN_ALPHA_START
        if is_frontal
        else PLANAR_START
        if plane
        else LINEAR_START
        for is_usable, is_frontal, plane in zip(usable, frontal, flat, strict=True)
    )
    diverged = ~np.isfinite(np.asarray(view_fits.rms))
    problems = tuple(
        text or ("the calibration diverged" if has_diverged else "")
        for text, has_diverged in zip(problems, diverged, strict=True)
    )
    by_view = (view_fits.intrinsics, view_fits.camera_from_world, view_fits.rms, alpha_relative_std)
    return ViewCalibrations(
        *without_padding(by_view, view_count),
        without_padding(view_fits.inliers, view_count, point_count),
        starts[:view_count],
        problems[:view_count],
    )


def estimate_view_poses(
    observations: Observations, camera: Camera
) -> tuple[SE3, Float[Array, "views"], Bool[Array, "views points"]]:
    """Compute the pose of every view for a known camera.

    Distortion is removed from the pixels first (the inverse pinhole map, Eq. 4, after
    undistortion, Eq. 3 for the paper's lens), so any lens can be used.

    Returns:
        `camera_from_world`, the RMS reprojection error of each view in px, and the points used.
    """
    view_count, point_count = observations.visible.shape
    points, ideal, visible = _ideal_observations(observations, camera)
    # Undistorted pixels relative to the principal point: an ideal pinhole camera with known alpha.
    alpha = float(camera.alpha_u)
    undistorted = alpha * ideal
    flat = coplanar(extents(points, visible))
    centre, longer_side = np.zeros(2), float(max(camera.image_size))
    start = view_starts(points, undistorted, visible, flat, centre, longer_side)
    pinhole = Intrinsics(*np.array([alpha, alpha, 0.0, 0.0, 0.0]))
    held_start = _hold_intrinsics(start, pinhole, np.ones(len(flat), dtype=bool), centre)
    none_free = np.zeros((len(flat), 5), dtype=bool)
    view_fits = _fit_all_views(points, undistorted, visible, held_start, none_free, flat)
    return (
        *without_padding((view_fits.camera_from_world, view_fits.rms), view_count),
        without_padding(view_fits.inliers, view_count, point_count),
    )


def unprojected(
    observations: Observations, camera: Camera
) -> tuple[Float[np.ndarray, "views points 2"], Bool[np.ndarray, "views points"]]:
    """Return the ideal coordinates x / z, y / z of the pixels, and where they are such."""
    views, points = observations.visible.shape
    _, ideal, usable = _ideal_observations(observations, camera)
    return ideal[:views, :points], usable[:views, :points]


def _ideal_observations(
    observations: Observations, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return padded points, ideal coordinates of the pixels, zero elsewhere, and where they are."""
    points, pixels, visible = _host_observations(observations.padded())
    rays, valid = map(np.asarray, unit_rays(camera, jax.device_put(pixels)))
    usable = visible & valid & (rays[..., 2] > 1e-3)
    ideal = rays[..., :2] / np.where(usable, rays[..., 2], 1.0)[..., None]
    return points, np.where(usable[..., None], ideal, 0.0), usable


def _host_observations(observations: Observations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, pixels and visibility as arrays of NumPy; unseen pixels are zero, not NaN."""
    visible = np.asarray(observations.visible)
    pixels = np.where(visible[..., None], np.asarray(observations.pixels), 0.0)
    return np.asarray(observations.points), pixels, visible


def _view_problems(
    point_counts: np.ndarray, collinear: np.ndarray, flat: np.ndarray
) -> tuple[str, ...]:
    """Return for every view why it shows too few points, or an empty text if it does not."""
    problems = []
    for count, on_line, plane in zip(point_counts, collinear, flat, strict=True):
        needed = 4 if plane else 6
        if count < needed:
            where = "in one plane" if plane else "in space"
            problems.append(f"{count} points seen, {needed} {where} needed")
        elif on_line:
            problems.append(f"the {count} points seen lie on one line")
        else:
            problems.append("")
    return tuple(problems)


def _select_by_view(views: np.ndarray, selected: ViewFit, unselected: ViewFit) -> ViewFit:
    """Return the first result in the given views and the second result in all others."""

    def select(a: Array, b: Array) -> np.ndarray:
        """Return the rows of one array in the given views, and of the other array elsewhere."""
        return np.where(views.reshape((-1,) + (1,) * (a.ndim - 1)), np.asarray(a), np.asarray(b))

    return jax.device_put(jax.tree.map(select, selected, unselected))


def _median_intrinsics(view_fits: ViewFit, usable: np.ndarray, frontal: np.ndarray) -> Intrinsics:
    """Return the median intrinsics over the views that determine alpha."""
    trusted = usable & ~frontal
    if not trusted.any():
        # With no oblique view at all, use the half with the smallest uncertainty.
        alpha_relative_std = np.asarray(view_fits.alpha_relative_std)
        trusted = usable & (alpha_relative_std <= np.median(alpha_relative_std[usable]))

    return jax.tree.map(lambda values: np.median(np.asarray(values)[trusted]), view_fits.intrinsics)


def _hold_intrinsics(
    start: Start, median: Intrinsics, chosen: np.ndarray, centre: np.ndarray
) -> Start:
    """Return the starts with the median intrinsics in the chosen views, depths rescaled to match.

    The size in the picture is alpha / depth, so depth is multiplied by the ratio of the alphas.
    """
    ratio = median.alpha_u / start.intrinsics.alpha_u
    held = Intrinsics(median.alpha_u, median.alpha_u, centre[0], centre[1], median.k1)
    intrinsics = jax.tree.map(
        lambda value, new: np.where(chosen, new, value), start.intrinsics, held
    )
    poses = np.array(start.poses.wxyz_xyz)
    poses[..., 6] *= np.where(chosen, ratio, 1.0)[:, None]
    return Start(intrinsics, SE3(poses))  # pyright: ignore[reportArgumentType]


def _fit_all_views(*by_view: Any) -> ViewFit:
    """Fit every view by `_fit_views`, in batches: one program then serves any small data set."""
    view_count, point_count = by_view[0].shape[:2]
    # A large data set is not padded and has programs of its own; hundreds of calls cost it a fifth.
    is_large = view_count * point_count > MAX_PADDED_OBSERVATIONS
    if is_large or view_count % _VIEWS_IN_BATCH or view_count == _VIEWS_IN_BATCH:
        return _fit_views(*by_view)
    by_view = jax.tree.map(np.asarray, by_view)
    fits = []
    for first in range(0, view_count, _VIEWS_IN_BATCH):
        batch = slice(first, first + _VIEWS_IN_BATCH)
        fits.append(_fit_views(*jax.tree.map(lambda x, batch=batch: x[batch], by_view)))
    return jax.tree.map(lambda *parts: to_device(np.concatenate(parts)), *fits)


@compiled_optimised
def _fit_views(
    points: Float[Array | np.ndarray, "views points 3"],
    pixels: Float[Array | np.ndarray, "views points 2"],
    visible: Bool[Array | np.ndarray, "views points"],
    start: Start,
    free: Bool[Array | np.ndarray, "views 5"],
    flat: Bool[Array | np.ndarray, "views"],
) -> ViewFit:
    """Fit every view from its two start poses and keep the one with the smaller RMS error.

    The two differ for coplanar points only: a small plane has two poses that look almost alike.
    """

    def fit_one_view(view):
        # `lax.map`, not `vmap`: each view stops when it has converged. Under `vmap` every view
        # would iterate until the slowest has finished.
        points, pixels, visible, intrinsics, poses, free, planar = view

        def fit_from_pose(rival_rms, pose_index):
            """Fit the view from one of its two start poses, if it may become the better one."""
            # Spatial points have one pose only; the second fit gets no points and ends at once.
            seen = visible & (planar | (pose_index == 0))
            pose = SE3(poses[pose_index])
            fit = fit_view(points, pixels, seen, intrinsics, pose, free, rival_rms)
            return fit.rms, fit

        _, fits = jax.lax.scan(fit_from_pose, jnp.asarray(jnp.inf), jnp.arange(2))
        valid = jnp.isfinite(fits.rms) & jnp.stack([jnp.asarray(True), planar])
        best = jnp.argmin(jnp.where(valid, fits.rms, jnp.inf))
        return jax.tree.map(lambda x: x[best], fits)

    return jax.lax.map(
        fit_one_view,
        (points, pixels, visible, start.intrinsics, start.poses.wxyz_xyz, free, flat),
    )
