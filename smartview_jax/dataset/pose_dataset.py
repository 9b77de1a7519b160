"""Hold pairs of a robot pose and a tracked pose of the target, checked when they are given."""

import dataclasses
from collections.abc import Sequence
from typing import Any, cast

import equinox as eqx
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..argument_checks import require_one_of
from ..calibration import ONE_ARM_MOUNTS
from ..cameras import Camera
from ..geometry import PoseLike, as_se3, check_rigid, host_matrices
from ..robots import SerialArm
from ..runtime.array_namespace import to_device
from ..schemas.covariances import (
    MAX_ASYMMETRY,
    SMALLEST_EIGENVALUE,
    smallest_correlation_eigenvalue,
)
from .dataset import Dataset, of_views
from .depth_sensor import DepthSensor
from .input_checks import checked_matrices, checked_view_ids, finite_views, forward_kinematics
from .pose_observations import PAIRS, PoseObservations

UNIT_TRANSLATION = 1e-3
"""Unit of the noise of tracked positions, m."""

UNIT_ROTATION = 1e-2
"""Unit of the noise of tracked orientations, rad: of a marker of 0.1 m with corners off by 1 mm."""


class PoseDataset(Dataset):
    """A data set of tracked poses in place of pictures: a pair of poses in each view.

    Attributes:
        camera_from_world: poses of the target that the tracker measured.
        covariance: of each tracked pose, for a tracker with noise of one unit: of its translation
            (m) and of its rotation vector (rad), both in the camera's axes, as in ROS's
            PoseWithCovariance.
        states_covariance: whether the covariances were given; otherwise the ratio of the noises of
            translation and rotation is estimated, and all poses are equal.
        sensor: the depth sensor that measured the poses; None for other trackers.
        sensor_changes: change of each pose, as in `covariance`, by the sensor's scale and offset
            (m): an error that all poses share.
        point_rms: RMS distance of the sensor's points from the target at its pose in each view, m,
            without the points left out; NaN in views that are not used.
        camera: of the depth sensor's pictures, if known.
    """

    camera_from_world: SE3 | None = None
    covariance: Float[Array, "views 6 6"] | None = None
    states_covariance: bool = eqx.field(static=True, default=False)
    sensor: DepthSensor | None = eqx.field(static=True, default=None)
    sensor_changes: Float[Array, "views 6 2"] | None = None
    point_rms: Float[Array, "views"] | None = None
    camera: Camera | None = None

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
        require_one_of("mount", mount, ONE_ARM_MOUNTS)
        tracked = getattr(camera_from_world, "wxyz_xyz", camera_from_world)
        count = len(np.asarray(tracked))
        ids = checked_view_ids(view_ids, count)
        if base_from_tool is None:
            base_from_tool = forward_kinematics(joints, arm, ids)
        robot = checked_matrices("base_from_tool", base_from_tool, count)
        measured = checked_matrices("camera_from_world", camera_from_world, count)
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
            covariance=_diagonal(UNIT_TRANSLATION, UNIT_ROTATION, len(ids)),
        )
        if joints is None and arm is None:
            return data
        return cast(PoseDataset, data.with_joints(joints, arm))

    @property
    def observations(self) -> PoseObservations:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The arrays of the data set, without names."""
        assert self.covariance is not None
        # r^T C^-1 r = |W r|^2 with C = L L^T and W = L^-1.
        whitening = np.linalg.inv(np.linalg.cholesky(np.asarray(self.covariance)))
        return PoseObservations(
            self.camera_from_world,  # pyright: ignore[reportArgumentType]
            to_device(whitening),
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
        names = "camera_from_world", "covariance", "sensor_changes", "point_rms"
        tracked = of_views(tuple(getattr(self, name) for name in names), index)
        return super()._arrays_of(index) | dict(zip(names, tracked, strict=True))

    def with_covariance(self, covariance: np.ndarray) -> "PoseDataset":
        """Return the data set with the covariance of each tracked pose.

        A fit takes their shapes and sizes relative to one another as given, and estimates one
        factor for all of them.

        Args:
            covariance: `(M, 6, 6)` as in the attributes; NaN where the target was not seen.

        Raises:
            ValueError: a wrong shape, or a matrix that is not a covariance; the message names the
                view.

        For example:

            >>> from smartview_jax.dataset import PoseDataset
            >>> tracked = truth.camera_from_world(scene.base_from_tool)
            >>> pairs = PoseDataset.from_poses(data.base_from_tool, tracked)
            >>> by_axis = np.diag([1e-4, 1e-4, 5e-4, 1e-3, 1e-3, 2e-4]) ** 2
            >>> pairs = pairs.with_covariance(np.tile(by_axis, (8, 1, 1)))
            >>> print(pairs.states_covariance)
            True
        """
        matrices = np.array(covariance, dtype=float)
        if matrices.shape != (self.view_count, 6, 6):
            raise ValueError(
                f"covariance: expected shape ({self.view_count}, 6, 6), found {matrices.shape}"
            )
        matrices[~self.seen] = _diagonal(UNIT_TRANSLATION, UNIT_ROTATION, 1)[0]
        valid = smallest_correlation_eigenvalue(matrices) > SMALLEST_EIGENVALUE
        stds = np.sqrt(np.diagonal(matrices[valid], axis1=1, axis2=2))
        asymmetry = np.abs(matrices[valid] - matrices[valid].mT) / stds[:, :, None] / stds[:, None]
        valid[valid] = asymmetry.max(axis=(1, 2), initial=0.0) < MAX_ASYMMETRY
        if len(wrong := np.flatnonzero(~valid)):
            view = wrong[0]
            raise ValueError(
                f"covariance: view {self.view_ids[view]}: expected a symmetric, positive definite "
                f"matrix of translation (m) and rotation (rad), found diagonal "
                f"{np.diagonal(matrices[view])}"
            )
        return dataclasses.replace(self, covariance=to_device(matrices), states_covariance=True)

    @property
    def typical_noise(self) -> tuple[float, float]:
        """Standard deviation per axis of the seen poses, as of `covariance`: m and rad (RMS)."""
        used = np.asarray(self.covariance)[self.seen]
        variances = np.diagonal(used, axis1=1, axis2=2).reshape(-1, 2, 3).mean(axis=(0, 2))
        return float(np.sqrt(variances[0])), float(np.sqrt(variances[1]))


def _diagonal(translation: float, rotation: float, count: int) -> Float[Array, "views 6 6"]:
    """Return equal covariances of the poses of all views, from standard deviations by axis."""
    variances = np.repeat([translation, rotation], 3) ** 2
    return to_device(np.tile(np.diag(variances), (count, 1, 1)))
