"""Measure the distance between predicted and measured points, in px and in mm at the target."""

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Bool, Float

from ..calibration import Calibration
from ..cameras import Camera
from ..dataset import Dataset, require_same_set_up, view_residuals
from ..robots import CommandLike
from ..runtime.array_namespace import AnyArray
from ..runtime.compilation import compiled


@runtime_checkable
class Predictor(Protocol):
    """A model that predicts where target points appear, such as a `Calibration`."""

    @property
    def camera(self) -> Camera: ...

    def points_in_camera(self, base_from_tool: CommandLike, points: Array) -> Array: ...

    def project(self, base_from_tool: CommandLike, points: Array) -> tuple[Array, Array]: ...


class ReprojectionErrors(NamedTuple):
    """The reprojection errors of points: distances between measured and predicted pixels.

    NaN for points not seen, infinite for points that were seen but cannot be predicted (behind the
    camera, or outside the lens's domain). The figures below are over predicted points only;
    `unpredicted_count` counts the others, and any report of the figures should state it.

    Attributes:
        px: distance in the image.
        metres: distance at the target: pixel distance x depth / focal length.
    """

    px: Float[np.ndarray, "views points"]
    metres: Float[np.ndarray, "views points"]

    @property
    def mean(self) -> float:
        """The mean reprojection error, px (the paper's registration error)."""
        values = self.values
        return float(np.mean(values)) if values.size else float("nan")

    @property
    def std(self) -> float:
        """The standard deviation of the reprojection errors, px."""
        values = self.values
        return float(np.std(values)) if values.size else float("nan")

    @property
    def rms(self) -> float:
        """The root mean square reprojection error over points, px."""
        return root_mean_square(self.px)

    @property
    def rms_mm(self) -> float:
        """The root mean square error over points, mm at the target."""
        return 1e3 * root_mean_square(self.metres)

    @property
    def rms_per_view(self) -> Float[np.ndarray, "views"]:
        """The RMS error of each view, px; NaN for a view without points."""
        return np.array([root_mean_square(row) for row in self.px])

    @property
    def values(self) -> Float[np.ndarray, "predicted"]:
        """The reprojection errors of all predicted points as one vector, px."""
        return self.px[np.isfinite(self.px)]

    @property
    def unpredicted_count(self) -> int:
        """The number of points that were seen but cannot be predicted."""
        return int(np.count_nonzero(np.isinf(self.px)))


def root_mean_square(values: np.ndarray) -> float:
    """Return the root mean square of the finite values; NaN if there are none."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")


def reprojection_errors(predictor: Predictor, data: Dataset) -> ReprojectionErrors:
    """Return the reprojection errors of all visible points; infinite without a prediction.

    Raises:
        ValueError: a calibration of another mount, or of pictures of another size.
    """
    if isinstance(predictor, Calibration):
        require_same_set_up("the calibration", predictor, data)
        return _chain_reprojection_errors(predictor, data)
    predicted, valid, depth = predict(predictor, data.command, data.points)
    return errors_of_predictions(predictor.camera, data, predicted, valid, depth)


def _chain_reprojection_errors(calibration: Calibration, data: Dataset) -> ReprojectionErrors:
    """Return the reprojection errors of a calibration, using the compiled programs of the fits."""
    poses = np.asarray(calibration.camera_from_world_matrices(data.command))
    residuals = view_residuals(
        calibration.camera,
        calibration.target_scale,
        poses,
        data.observations.of_shape(calibration.target_shape),
    )
    # Residuals are infinite where a point that was seen cannot be predicted.
    px = np.where(np.asarray(data.visible), np.linalg.norm(residuals, axis=-1), np.nan)
    points = np.asarray(calibration.true_points(data.points))
    depth = np.einsum("vi,vni->vn", poses[:, 2, :3], points) + poses[:, 2, 3, None]
    return errors_at_target(calibration.camera, px, depth)


def errors_of_predictions(
    camera: Camera,
    data: Dataset,
    predicted: Float[AnyArray, "views points 2"],
    valid: Bool[AnyArray, "views points"],
    depth: Float[AnyArray, "views points"],
) -> ReprojectionErrors:
    """Return the reprojection errors of predicted pixels whose points have the given depths (m)."""
    error = np.linalg.norm(np.asarray(data.pixels) - np.asarray(predicted), axis=-1)
    visible = np.asarray(data.visible)
    # NaN for unseen and infinity for unpredicted points: neither passes for a small error.
    px = np.where(visible, np.where(np.asarray(valid), error, np.inf), np.nan)
    return errors_at_target(camera, px, depth)


def errors_at_target(
    camera: Camera, px: Float[np.ndarray, "views points"], depth: Float[AnyArray, "views points"]
) -> ReprojectionErrors:
    """Return reprojection errors (px) with the distances at the target, at the given depths (m)."""
    # Pixel distance x depth / focal length, with the geometric mean of the two focal lengths.
    focal = np.sqrt(abs(float(camera.alpha_u) * float(camera.alpha_v)))
    # A depth of exactly zero would make an unpredicted point's infinity a NaN.
    distance = np.maximum(np.abs(np.asarray(depth)), np.finfo(float).tiny)
    return ReprojectionErrors(px, px * distance / focal)


@compiled
def predict(
    predictor: Predictor, command: CommandLike, points: Array
) -> tuple[Array, Bool[Array, "views points"], Array]:
    """Return predicted pixels, their validity and the points' depths (m)."""
    pixels, valid = predictor.project(command, points)
    return pixels, valid, predictor.points_in_camera(command, points)[..., 2]
