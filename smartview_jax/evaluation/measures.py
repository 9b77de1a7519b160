"""How far predicted points lie from measured ones, in pixels and in millimetres at the target."""

from typing import NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..cameras import Camera
from ..compilation import compiled
from ..dataset import Dataset
from ..robots import CommandLike


@runtime_checkable
class Predictor(Protocol):
    """Whatever says where target points appear from a robot pose: a `Calibration`, for one."""

    @property
    def camera(self) -> Camera: ...

    def points_in_camera(self, base_from_tool: CommandLike, points: Array) -> Array: ...

    def project(self, base_from_tool: CommandLike, points: Array) -> tuple[Array, Array]: ...


class Deviations(NamedTuple):
    """Distances between measured and predicted points.

    NaN where a point was not seen, infinite where one was seen that cannot be predicted at all
    (behind the camera, outside the lens's domain). The figures below are over the predicted ones;
    `unpredicted` counts the others, and whoever prints a figure prints that count too.

    Attributes:
        px: in the picture.
        m: at the target: pixel deviation x depth / focal length.
    """

    px: Float[np.ndarray, "views points"]
    m: Float[np.ndarray, "views points"]

    @property
    def mean(self) -> float:
        """Mean deviation, px (the paper's registration error)."""
        values = self.values
        return float(np.mean(values)) if values.size else float("nan")

    @property
    def std(self) -> float:
        """Standard deviation of the deviations, px."""
        values = self.values
        return float(np.std(values)) if values.size else float("nan")

    @property
    def rms(self) -> float:
        """Root mean square deviation over points, px."""
        return _rms(self.px)

    @property
    def rms_mm(self) -> float:
        """Root mean square deviation over points, mm at the target."""
        return 1e3 * _rms(self.m)

    @property
    def per_view(self) -> Float[np.ndarray, "views"]:
        """RMS of each view, px; NaN for a view without points."""
        return np.array([_rms(row) for row in self.px])

    @property
    def values(self) -> Float[np.ndarray, "predicted"]:
        """The deviations of all predicted points in one row, px."""
        return self.px[np.isfinite(self.px)]

    @property
    def unpredicted(self) -> int:
        """How many points were seen that cannot be predicted."""
        return int(np.count_nonzero(np.isinf(self.px)))


def _rms(values: np.ndarray) -> float:
    found = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(found**2))) if found.size else float("nan")


def deviations(predictor: Predictor, data: Dataset) -> Deviations:
    """Deviations of everything that was seen; infinite where it cannot be predicted."""
    predicted, valid, depth = predict(predictor, data.command, data.points)
    return measured(predictor.camera, data, predicted, valid, depth)


def measured(
    camera: Camera,
    data: Dataset,
    predicted: Float[Array, "views points 2"],
    valid: Bool[Array, "views points"],
    depth: Float[Array, "views points"],
) -> Deviations:
    """Deviations of predicted pixels whose points lie at these depths (m)."""
    error = np.linalg.norm(np.asarray(data.pixels) - np.asarray(predicted), axis=-1)
    visible = np.asarray(data.visible)
    px = np.where(visible, np.where(np.asarray(valid), error, np.inf), np.nan)
    return at_target(camera, px, depth)


def at_target(
    camera: Camera, px: Float[np.ndarray, "views points"], depth: Float[Array, "views points"]
) -> Deviations:
    """Lengths in the picture, px, of points at these depths (m), and what they are there."""
    focal = float(jnp.sqrt(jnp.abs(camera.alpha_u * camera.alpha_v)))
    # A depth of exactly zero would make an unpredicted point's infinity a NaN.
    distance = np.maximum(np.abs(np.asarray(depth)), np.finfo(float).tiny)
    return Deviations(px, px * distance / focal)


@compiled
def predict(
    predictor: Predictor, command: CommandLike, points: Array
) -> tuple[Array, Bool[Array, "views points"], Array]:
    """Pixels, where they are valid, and depths (m)."""
    pixels, valid = predictor.project(command, points)
    return pixels, valid, predictor.points_in_camera(command, points)[..., 2]
