"""Hold pairs of a robot pose and a tracked pose of the target, checked when they are given."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..calibration import mount_frames
from ..geometry import PoseLike, as_se3, check_rigid, host_matrices, host_nearest_pose
from ..robots import SerialArm
from ..runtime.array_namespace import to_device
from .dataset import Dataset, of_views
from .input_checks import checked_view_ids, finite_views, forward_kinematics, pose_matrices
from .pose_observations import PAIRS, PoseObservations

UNIT_TRANSLATION = 1e-3
"""Unit of the noise of tracked positions, m."""

MIN_RELATIVE_WIDTH = 1e-3
"""Smallest width of a set of points that is not a line, relative to its length."""

UNIT_ROTATION = 1e-2
"""Unit of the noise of tracked orientations, rad: of a marker of 0.1 m with corners off by 1 mm."""


class _NearestPose(NamedTuple):
    """The pose of some points that is nearest to where they were measured.

    Attributes:
        matrix: the pose.
        size: spread of the measured points over the spread of the points themselves.
    """

    matrix: Float[np.ndarray, "4 4"]
    size: float


def _nearest_pose(
    points: Float[np.ndarray, "points 3"], measured: Float[np.ndarray, "points 3"]
) -> _NearestPose | None:
    """Return the pose that brings points nearest to measured ones, by least squares.

    None for points that do not determine it: fewer than three, or all on one line.
    """
    if len(points) < 3:
        return None
    a, b = points - points.mean(axis=0), measured - measured.mean(axis=0)
    spreads = np.linalg.svd(a, compute_uv=False)
    if spreads[1] < MIN_RELATIVE_WIDTH * spreads[0]:
        return None
    size = float(np.sqrt(np.sum(b**2) / np.sum(a**2)))
    return _NearestPose(host_nearest_pose(points, measured), size)


class PoseDataset(Dataset):
    """A data set of tracked poses in place of pictures: a pair of poses in each view.

    Attributes:
        camera_from_world: poses of the target that the tracker measured.
        units: as in `PoseObservations`.
    """

    camera_from_world: SE3 | None = None
    units: Float[Array, "views 2"] | None = None

    @classmethod
    def from_poses(
        cls,
        base_from_tool: PoseLike | None,
        camera_from_world: PoseLike,
        mount: str = "eye_in_hand",
        view_ids: Sequence[str | int] | None = None,
        masked_views: Sequence[tuple[str, str]] = (),
        joints: np.ndarray | Array | None = None,
        arm: SerialArm | None = None,
    ) -> "PoseDataset":
        """Build a data set from arrays.

        Args:
            base_from_tool: `(M,)` robot poses: an `SE3` or `(M, 4, 4)`, m; None if joints and an
                arm are given instead.
            camera_from_world: `(M,)` poses of the target in the camera's frame; NaN where it was
                not seen.
            mount: `"eye_in_hand"` (camera on the tool) or `"eye_to_hand"` (fixed camera).
            view_ids: one name per pair; by default 0, 1, ...
            masked_views: views known to be unusable, with the reason.
            joints: `(M, joints)` readings, rad, or m for a prismatic joint.
            arm: the arm whose joints these are, with its controller's nominal parameters.

        Raises:
            ValueError: a wrong shape, a duplicate id, or a pose that is not rigid; the message
                names the view.
        """
        mount_frames(mount)
        tracked = getattr(camera_from_world, "wxyz_xyz", camera_from_world)
        count = len(np.asarray(tracked))
        ids = checked_view_ids(view_ids, count)
        if base_from_tool is None:
            base_from_tool = forward_kinematics(joints, arm, ids)
        robot = pose_matrices(base_from_tool, count)
        measured = pose_matrices(camera_from_world, count)
        reasons = dict(masked_views)
        seen = finite_views(measured)[:, 0, 0] & [view not in reasons for view in ids]
        measured = np.where(seen[:, None, None], measured, np.eye(4))
        wrong = {view: f"robot: {text}" for view, text in check_rigid(robot, ids).items()}
        wrong |= {view: f"tracker: {text}" for view, text in check_rigid(measured, ids).items()}
        if wrong:
            raise ValueError("; ".join(f"view {view}: {text}" for view, text in wrong.items()))
        visible = np.repeat(seen[:, None], PAIRS, axis=1)
        data = cls(
            points=to_device(np.zeros((*visible.shape, 3))),
            pixels=to_device(np.where(visible[..., None], 0.0, np.nan).repeat(2, axis=2)),
            visible=to_device(visible),
            base_from_tool=as_se3(robot),
            view_ids=ids,
            image_size=(0, 0),
            mount=mount,
            masked_views=tuple(
                (view, reasons.get(view, "the target was not seen"))
                for view, is_seen in zip(ids, seen, strict=True)
                if not is_seen
            ),
            camera_from_world=as_se3(measured),
            units=to_device(np.tile([UNIT_TRANSLATION, UNIT_ROTATION], (len(ids), 1))),
        )
        if joints is None and arm is None:
            return data
        return cast(PoseDataset, data.with_joints(joints, arm))

    @classmethod
    def from_points(
        cls,
        base_from_tool: PoseLike | None,
        points: np.ndarray,
        points_in_camera: np.ndarray,
        mount: str = "eye_in_hand",
        view_ids: Sequence[str | int] | None = None,
        joints: np.ndarray | Array | None = None,
        arm: SerialArm | None = None,
    ) -> "PoseDataset":
        """Build a data set from target points that a depth camera or a scanner measured.

        Each view's pose is the one that brings the target's points nearest to the measured ones
        (Kabsch, 1976). A sensor that measures everything too large by a factor also shifts the
        pose by it: `fit_poses(data, scale=True)` estimates the factor from the robot's motion, and
        `notes` has the factor that the target's own size suggests.

        Args:
            base_from_tool: as in `from_poses`.
            points: `(N, 3)` points of the target in its own frame, m.
            points_in_camera: `(M, N, 3)` the same points as the sensor measured them in its frame,
                m; NaN for points that were not measured.
            mount, view_ids, joints, arm: as in `from_poses`.

        Raises:
            ValueError: a wrong shape, a duplicate id, no view with three points that are not on one
                line, or a robot pose that is not rigid.
        """
        points, measured = np.asarray(points, dtype=float), np.asarray(points_in_camera, float)
        if points.ndim != 2 or measured.shape[1:] != points.shape or points.shape[1:] != (3,):
            raise ValueError(
                "points_in_camera: expected shape (views, points, 3) for points of shape (points, "
                f"3), found {measured.shape} and {points.shape}"
            )
        ids = checked_view_ids(view_ids, len(measured))
        poses, sizes, reasons = np.full((len(ids), 4, 4), np.nan), [], []
        for view, seen in enumerate(measured):
            used = np.isfinite(seen).all(axis=1)
            fitted = _nearest_pose(points[used], seen[used])
            if fitted is None:
                text = f"{used.sum()} points measured; expected 3 that are not on one line"
                reasons.append((ids[view], text))
                continue
            poses[view] = fitted.matrix
            sizes.append(fitted.size)
        if not sizes:
            raise ValueError(f"view {reasons[0][0]}: {reasons[0][1]}; so are all views")
        data = cls.from_poses(base_from_tool, poses, mount, ids, reasons, joints, arm)
        size = float(np.median(sizes))
        note = f"the measured points are {size:.4f} times as far apart as the target's"
        return dataclasses.replace(data, notes=(*data.notes, note))

    @property
    def observations(self) -> PoseObservations:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The arrays of the data set, without names."""
        return PoseObservations(
            self.camera_from_world,  # pyright: ignore[reportArgumentType]
            self.units,  # pyright: ignore[reportArgumentType]
            self.visible,
            self.base_from_tool,
            self.joints,
        )

    @property
    def tracked_matrices(self) -> Float[np.ndarray, "views 4 4"]:
        """The tracked poses `camera_from_world` as matrices on the host."""
        assert self.camera_from_world is not None
        return host_matrices(self.camera_from_world)

    @property
    def seen(self) -> Bool[np.ndarray, "views"]:
        """Mask of the views in which the target was seen, and that are not masked."""
        return np.asarray(np.asarray(self.visible).all(axis=1))

    def usable_views(self, minimum_points: int = PAIRS) -> np.ndarray:
        """Return the indices of the views in which the target was seen."""
        return np.flatnonzero(self.seen)

    def _arrays_of(self, index: np.ndarray) -> dict[str, Any]:
        """Return the arrays of the given views, by name."""
        tracked = of_views((self.camera_from_world, self.units), index)
        return super()._arrays_of(index) | dict(
            zip(("camera_from_world", "units"), tracked, strict=True)
        )

    def with_units(self, translation: float, rotation: float) -> "PoseDataset":
        """Return the data set with other units of the tracker's noise, m and rad."""
        units = np.tile([translation, rotation], (self.view_count, 1))
        return dataclasses.replace(self, units=to_device(units))
