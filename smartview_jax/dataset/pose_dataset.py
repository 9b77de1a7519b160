"""Hold pairs of a robot pose and a tracked pose of the target, checked when they are given."""

import dataclasses
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..calibration import mount_frames
from ..geometry import PoseLike, as_se3, check_rigid, host_matrices
from ..robots import SerialArm
from ..runtime.array_namespace import to_device
from .dataset import Dataset, of_views
from .input_checks import checked_view_ids, finite_views, forward_kinematics, pose_matrices
from .pose_observations import PAIRS, PoseObservations

UNIT_TRANSLATION = 1e-3
"""Unit of the noise of tracked positions, m."""

UNIT_ROTATION = 1e-2
"""Unit of the noise of tracked orientations, rad: of a marker of 0.1 m with corners off by 1 mm."""


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
