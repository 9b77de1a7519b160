"""Find out that a target bends: a sheet or a thin board that has another shape in each view.

A free pose in each view, the camera and one bow that is common to all views explain the pictures of
any stiff target. A sheet that is lifted, taped or pressed bows otherwise in each view, which leaves
several times the noise, and moves the poses of its views. With small errors the residuals are
linear in all of these numbers, and least squares tells how much a bow of each view's own leaves.
The numbers that each view has by itself are eliminated first, the camera's are common.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float

from ..cameras import Camera
from ..dataset import Observations, camera_residuals
from ..geometry import host_matrices
from ..runtime.array_namespace import to_device

STEP = 1e-5
"""Step of the differences, m, rad, or relative to a camera's number and at least to 1."""


MAX_LEFT_OVER = 0.5
"""Largest ratio of the squared residuals with a bow in each view to those with a common one: the
bows explain more than all else together."""

MIN_RMS = 1e-3
"""Smallest RMS of the residuals with a common bow, px.

No detector is as good: less is what rounding and steps of differences leave in rendered pictures.
"""

MIN_POINTS, MIN_VIEWS = 12, 5
"""Fewest points of a view, which has 9 numbers: noise alone leaves four fifths; and fewest views
that tell the common camera from their bows."""


class FlexibleTarget(NamedTuple):
    """A target that has another shape in each view.

    Attributes:
        bow: usual height of the target's middle over its rim, without the common one, m.
        rms: root mean square of the residuals with a bow of each view's own, px.
        given_rms: the same with one bow that is common to all views.
    """

    bow: float
    rms: float
    given_rms: float

    @property
    def sentence(self) -> str:
        """The fault of the target in words, and what to do."""
        return (
            "the target bends: its shape seems to change from view to view, by "
            f"{1e3 * self.bow:.2g} mm between middle and rim: with that, the pictures agree to "
            f"{self.rms:.2g} px instead of {self.given_rms:.2g} px RMS. Fix it on a stiff, flat "
            "plate, and take the pictures again"
        )


def find_flexible_target(
    observations: Observations,
    inliers: Bool[np.ndarray, "views points"],
    camera: Camera,
    camera_from_world: SE3,
) -> FlexibleTarget | None:
    """Return how a flat target bends from view to view; None if it does not, or is not flat.

    Args:
        observations: points and pixels.
        inliers: mask of the points to use.
        camera: common to all views.
        camera_from_world: the pose of each view that fits best with this camera.
    """
    points, seen = np.asarray(observations.points), np.asarray(inliers)
    views = np.flatnonzero(seen.sum(axis=1) >= MIN_POINTS)
    if len(views) < MIN_VIEWS or np.ptp(points[..., 2]) > STEP:
        return None
    offsets = points - points[0].mean(axis=0)
    half = float(np.abs(offsets).max())
    x, y = offsets[..., 0] / half, offsets[..., 1] / half
    # Of points behind the camera, differences of infinite residuals are none.
    with np.errstate(invalid="ignore"):
        derivatives = _derivatives(
            observations, camera, host_matrices(camera_from_world), np.stack([x * x, x * y, y * y])
        )
    equations = [
        _ViewEquations(
            *(part[view][seen[view]].reshape(2 * seen[view].sum(), -1) for part in derivatives)
        )
        for view in views
    ]
    bowed = _least_squares(
        [np.concatenate([view.by_pose, view.by_height], axis=1) for view in equations],
        [view.by_camera for view in equations],
        [view.residuals[:, 0] for view in equations],
    )
    common = _least_squares(
        [view.by_pose for view in equations],
        [np.concatenate([view.by_camera, view.by_height], axis=1) for view in equations],
        [view.residuals[:, 0] for view in equations],
    )
    count = sum(len(view.residuals) for view in equations)
    rms, given_rms = (float(np.sqrt(2.0 * fit.squares / count)) for fit in (bowed, common))
    if given_rms < MIN_RMS or bowed.squares > MAX_LEFT_OVER * common.squares:
        return None
    bows = np.array([view[6:] for view in bowed.by_view])
    # A bow of 1 lifts the rim by one metre over the middle; x y lifts corners alone.
    bow = float(np.sqrt(np.mean((bows - bows.mean(axis=0))[:, [0, 2]] ** 2)))
    return FlexibleTarget(bow, rms, given_rms)


class _ViewEquations(NamedTuple):
    """The residuals of one view, and their derivatives, a row for each coordinate.

    Attributes:
        residuals: of the pixels, px.
        by_camera: by the camera's numbers.
        by_pose: by a twist of the pose.
        by_height: by the heights of bows along x, x y and y.
    """

    residuals: Float[np.ndarray, "rows 1"]
    by_camera: Float[np.ndarray, "rows numbers"]
    by_pose: Float[np.ndarray, "rows 6"]
    by_height: Float[np.ndarray, "rows 3"]


def _derivatives(
    observations: Observations,
    camera: Camera,
    poses: Float[np.ndarray, "views 4 4"],
    heights: Float[np.ndarray, "bows views points"],
) -> tuple[Float[np.ndarray, "views points 2 _"], ...]:
    """Return the residuals and their derivatives as in `_ViewEquations`, for all views.

    They are not finite where a point cannot be predicted, as behind the camera of a view that is
    not used.
    """

    def residuals(camera: Camera = camera, poses: np.ndarray = poses) -> np.ndarray:
        """Return the residuals, px."""
        return camera_residuals(camera, poses, observations)

    given = residuals()
    shifts = np.tile(np.eye(4), (3, 1, 1))
    shifts[:, :3, 3] = STEP * np.eye(3)
    by_point = np.stack([(residuals(poses=shift @ poses) - given) / STEP for shift in shifts], 3)
    rotations = poses[:, :3, :3]
    in_camera = np.asarray(observations.points) @ rotations.swapaxes(1, 2) + poses[:, None, :3, 3]
    # A turn w moves a point p by w x p, a height h by h times the target's normal.
    by_turn = np.cross(in_camera[:, :, None], by_point)
    by_height = (by_point @ rotations[:, None, :, 2:])[..., 0]
    leaves, structure = jax.tree.flatten(camera)
    values = [np.asarray(leaf) for leaf in leaves]
    by_camera = []
    for k, value in enumerate(values):
        step = STEP * max(abs(float(value)), 1.0)
        moved = jax.tree.unflatten(
            structure, [*leaves[:k], to_device(value + step), *leaves[k + 1 :]]
        )
        by_camera.append((residuals(camera=moved) - given) / step)
    return (
        given[..., None],
        np.stack(by_camera, axis=3),
        np.concatenate([by_point, by_turn], axis=3),
        np.stack([by_height * height[..., None] for height in heights], axis=3),
    )


class _Solution(NamedTuple):
    """A least-squares solution.

    Attributes:
        squares: sum of the squares that are left over.
        by_view: numbers of each view.
    """

    squares: float
    by_view: list[np.ndarray]


def _least_squares(
    by_view: list[np.ndarray], shared: list[np.ndarray], residuals: list[np.ndarray]
) -> _Solution:
    """Solve for numbers of each view and numbers that all views share.

    The views' own numbers are eliminated: what is perpendicular to their columns does not know
    them, and determines the shared ones.

    Args:
        by_view: derivatives of each view's residuals by its own numbers, `(rows, numbers)` each.
        shared: the same by the numbers that all views share.
        residuals: of each view, px, `(rows)` each.
    """
    reduced = []
    for alone, common, errors in zip(by_view, shared, residuals, strict=True):
        basis = np.linalg.qr(alone)[0]
        both = np.concatenate([common, errors[:, None]], axis=1)
        reduced.append(both - basis @ (basis.T @ both))
    # Columns of very different units; one that all poses explain has no length of its own.
    normal = sum(part.T @ part for part in reduced)
    assert not isinstance(normal, int)
    sizes = np.maximum(np.sqrt(np.diagonal(normal)[:-1]), 1e-12)
    scaled = normal[:-1, :-1] / np.outer(sizes, sizes)
    numbers = -np.linalg.lstsq(scaled, normal[:-1, -1] / sizes, rcond=1e-10)[0] / sizes
    squares = sum(float(np.sum((part[:, -1] + part[:, :-1] @ numbers) ** 2)) for part in reduced)
    of_views = [
        -np.linalg.lstsq(alone, errors + common @ numbers, rcond=1e-10)[0]
        for alone, common, errors in zip(by_view, shared, residuals, strict=True)
    ]
    return _Solution(squares, of_views)
