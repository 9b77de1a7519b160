"""The result of the staged pipeline, and the interface of its Step 2."""

import dataclasses
from typing import Protocol, runtime_checkable

import equinox as eqx
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from ..calibration import Calibration, mount_frames, mount_from_holder_matrices
from ..cameras import Camera
from ..data_checks import CameraDoubt, ConventionReport
from ..dataset import Dataset
from ..fit_result import FitResult, Rejection
from ..geometry import ViewedRegion, host_matrices
from ..hand_eye import HandEyeResult
from ..runtime.modules import HostModule, with_fields
from .interpolation import Interpolation
from .weng import ViewCalibrations


@dataclasses.dataclass(frozen=True)
class CommonCameraOptions:
    """The options of Step 2, for the filter and for the batch fit.

    Attributes:
        pixel_sigma: standard deviation of u and of v, px; None to estimate it robustly.
        gate_probability: probability that the innovation of a good measurement passes the gate.
        hold_camera: treat the camera as known and refine the poses only.
    """

    pixel_sigma: float | None = None
    gate_probability: float = 0.9999
    hold_camera: bool = False

    @property
    def gate(self) -> float:
        """The largest squared innovation of a good measurement, relative to its covariance."""
        # Quantile of chi-square with two degrees of freedom: P(x <= g) = 1 - exp(-g / 2).
        return -2.0 * np.log1p(-self.gate_probability)


@runtime_checkable
class CommonCameraFit(Protocol):
    """The interface of a result of Step 2: a `KalmanResult`, or the result of the batch fit.

    Attributes:
        camera: the common camera.
        camera_from_world: one pose per view.
        inliers: the observations used.
        pixel_sigma: standard deviation of u and of v, px.
        rms: root mean square reprojection error of the inliers, px.
        converged: whether the fit converged.
        message: the outcome in words.
    """

    @property
    def camera(self) -> Camera: ...
    @property
    def camera_from_world(self) -> SE3: ...
    @property
    def inliers(self) -> Bool[Array, "views points"]: ...
    @property
    def pixel_sigma(self) -> Float[Array, ""] | float: ...
    @property
    def rms(self) -> Float[Array, ""] | float: ...
    @property
    def converged(self) -> bool: ...
    @property
    def message(self) -> str: ...


class StagedFit(HostModule):
    """The result of the staged pipeline.

    Attributes:
        calibration: camera, hand-eye and world transforms.
        step1: per-view calibrations; None if the camera was given.
        step2: common camera and per-view poses, with their covariance.
        step3: the hand-eye solution with every start tried.
        residuals: measured minus predicted through the whole chain, px; 0 where not seen.
        inliers: the observations that Step 2 kept, in the views that were used.
        rejected: view id, point index (None for a whole view) and reason.
        views: indices of the views that Step 3 used.
        conventions: how well robot and camera motion agree.
        result: whether all steps converged.
        warnings: the reasons to doubt the answer, a sentence each.
        camera_doubt: the one about the common camera, which is among them; None without.

    For example:

        >>> staged = fit.staged
        >>> print(staged.views, f"{float(staged.step2.rms):.2f} px without the robot")
        (0, 1, 2, 3, 4, 5, 6, 7) 0.18 px without the robot
    """

    calibration: Calibration
    step1: ViewCalibrations | None
    step2: CommonCameraFit
    step3: HandEyeResult
    residuals: Float[Array, "views points 2"]
    inliers: Bool[Array, "views points"]
    rejected: tuple[Rejection, ...] = eqx.field(static=True)
    views: tuple[int, ...] = eqx.field(static=True)
    conventions: ConventionReport = eqx.field(static=True)
    result: FitResult = eqx.field(static=True)
    warnings: tuple[str, ...] = eqx.field(static=True, default=())
    camera_doubt: CameraDoubt | None = eqx.field(static=True, default=None)

    def interpolation(self, data: Dataset) -> Interpolation:
        """Return the paper's comparison method: interpolation between the viewpoints of `data`."""
        views = np.array(self.views)
        robot = SE3(data.base_from_tool.wxyz_xyz[views])
        camera_from_world = SE3(self.step2.camera_from_world.wxyz_xyz[views])
        return Interpolation(self.step2.camera, robot, camera_from_world)


def with_region(
    calibration: Calibration, data: Dataset, views: Int[np.ndarray, "used"] | None = None
) -> Calibration:
    """Return the calibration with the region from which these views saw the target.

    Camera positions are computed by the chain without robot error; its size does not matter here.

    Args:
        calibration: fitted to the data.
        data: the data it was fitted to.
        views: indices of the views used; by default all views with visible points. If there is
            none, or the calibration is not finite, it is returned unchanged.
    """
    used = data.usable_views(1) if views is None else views
    base_from_tool = host_matrices(data.base_from_tool)[used]
    camera_from_mount = host_matrices(calibration.camera_from_mount)
    holder_from_world = host_matrices(calibration.holder_from_world)
    if not len(used) or not np.isfinite([camera_from_mount, holder_from_world]).all():
        return calibration
    in_hand = mount_frames(calibration.mount)[0] == "tool"
    # Eq. 10 inverted, without the camera: world <- holder <- mount <- camera.
    mount_from_holder = mount_from_holder_matrices(calibration.mount, base_from_tool)
    world_from_mount = np.linalg.inv(mount_from_holder @ holder_from_world)
    world_from_camera = world_from_mount @ np.linalg.inv(camera_from_mount)
    seen, points = np.asarray(data.visible)[used], np.asarray(data.points)
    # Points are copied only where some of them were not seen: there may be millions.
    points = points[used][seen] if len(used) < len(points) or not seen.all() else points
    scale = float(calibration.target_scale)
    points = (points if scale == 1.0 else scale * points).reshape(-1, 3)
    # How low the tool came over the target matters only if the tool carries the camera.
    tool_positions = world_from_mount[:, :3, 3] if in_hand else None
    region = ViewedRegion.from_positions(world_from_camera[:, :3, 3], points, tool_positions)
    return with_fields(calibration, region=region)
