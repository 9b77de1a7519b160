"""Build the normal equations of points, lines and the calibration's numbers from their pictures."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...cameras import moved_cameras
from ...engine import AbstractLoss
from ...geometry import host_exponentials
from ...robots import CommandLike
from ...runtime.array_namespace import to_device
from ...runtime.compilation import compiled
from ..calibration_uncertainty import CalibrationUncertainty, camera_parameter_count
from ..line_jacobians import line_jacobians
from ..line_triangulation import end_covariances
from ..pixel_jacobians import pixel_jacobians
from ..rig_views import AnyCalibration
from ..triangulation import CLICK_SIGMA
from ..view_poses import SeenViews, whitening_of
from .constrained_system import FeatureBlocks
from .constraint_geometry import Shape


class ModelObservations(NamedTuple):
    """The features of an object in calibrated views.

    Attributes:
        calibration: the calibrated camera.
        poses: what the robot reported in each view, `base_from_tool`.
        pixels: `(views, vertices, 2)`, px.
        visible: `(views, vertices)`; by default where the pixels are finite.
        pixel_sigma: as in `triangulate_points`.
        segments: `(views, lines, 2, 2)`, ends of the segments of straight lines, px; None for none.
        segments_visible: `(views, lines)`; by default where the ends are finite.
        segment_sigma: as in `triangulate_lines`.
    """

    calibration: AnyCalibration
    poses: CommandLike | None
    pixels: np.ndarray
    visible: np.ndarray | None = None
    pixel_sigma: float | np.ndarray = CLICK_SIGMA
    segments: np.ndarray | None = None
    segments_visible: np.ndarray | None = None
    segment_sigma: float | np.ndarray = CLICK_SIGMA


class CheckedObservations(NamedTuple):
    """The observations of an object as checked arrays.

    Attributes:
        views: camera and poses.
        pixels, visible, whitening: of the vertices.
        segments, segments_visible, covariances: of the lines; empty without lines.
    """

    views: SeenViews
    pixels: Float[np.ndarray, "views points 2"]
    visible: Bool[np.ndarray, "views points"]
    whitening: Float[np.ndarray, "#views #points 2 2"]
    segments: Float[np.ndarray, "views lines 2 2"]
    segments_visible: Bool[np.ndarray, "views lines"]
    covariances: Float[np.ndarray, "views lines 2 2 2"]

    @classmethod
    def of(cls, observations: ModelObservations) -> "CheckedObservations":
        """Check the arrays of observations."""
        views = SeenViews.of(observations.calibration, observations.poses)
        pixels, visible = views.checked_points(observations.pixels, observations.visible)
        # Without lines the arrays are empty, so that no special case is needed below.
        segments, segments_visible = views.checked_segments(
            np.zeros((len(pixels), 0, 2, 2))
            if observations.segments is None
            else observations.segments,
            observations.segments_visible,
        )
        return cls(
            views,
            np.where(visible[..., None], pixels, 0.0),
            visible,
            whitening_of(observations.pixel_sigma, visible.shape),
            segments,
            segments_visible,
            end_covariances(observations.segment_sigma, segments_visible.shape),
        )


class PictureEquations(NamedTuple):
    """The normal equations of features and numbers, from their pictures alone.

    Attributes:
        cost: half the sum of squared whitened residuals, or of their loss.
        features: normal matrix of each feature.
        feature_gradient: gradient by the features, points first.
        numbers: normal matrix of the numbers.
        number_gradient: gradient by the numbers.
        coupling: mixed second derivatives of features and numbers.
        residuals: measured minus predicted pixels of points; zero where not visible.
    """

    cost: float
    features: FeatureBlocks
    feature_gradient: Float[np.ndarray, "rows"]
    numbers: Float[np.ndarray, "numbers numbers"]
    number_gradient: Float[np.ndarray, "numbers"]
    coupling: Float[np.ndarray, "rows numbers"]
    residuals: Float[np.ndarray, "views points 2"]


def picture_equations(
    observed: CheckedObservations,
    shape: Shape,
    uncertainty: CalibrationUncertainty,
    offsets: Float[np.ndarray, "all_numbers"],
    columns: Float[np.ndarray, "all_numbers numbers"],
    loss: AbstractLoss | None = None,
) -> PictureEquations:
    """Return the normal equations at a shape and at offsets of the calibration's numbers.

    Args:
        uncertainty: the numbers and their effect on every view.
        offsets: of the numbers from the calibration.
        columns: combinations of the numbers to differentiate by.
        loss: robust loss of the points' whitened residuals; None is least squares.
    """
    views, poses = _displaced(observed.views, uncertainty, offsets)
    local = uncertainty.view_jacobian @ columns
    projected = pixel_jacobians(views, shape.points, poses)
    residuals = np.where(observed.visible[..., None], observed.pixels - projected.pixels, 0.0)
    # Whitened errors e = L (f(x) - z), so that the gradient is J^T e.
    whitening = np.where(observed.visible[..., None, None], observed.whitening, 0.0)
    e = np.einsum("vpij,vpj->vpi", whitening, -residuals)
    squared = np.sum(e**2, axis=-1)
    cost, weight = _robust(loss, squared)
    # A step that moves a point behind a camera is rejected by its infinite cost.
    if np.any(observed.visible & ~projected.valid):
        cost = np.inf
    root = np.sqrt(weight)[..., None]
    J = (whitening @ projected.by_point) * root[..., None]
    N = (whitening @ projected.by_view) * root[..., None]
    points = _accumulate(e * root, J, N, local)

    at = line_jacobians(
        views,
        shape.lines,
        observed.segments,
        observed.covariances,
        observed.segments_visible,
        poses,
    )
    e, weights = at.distances * at.weights, at.weights[..., None]
    lines = _accumulate(e, at.by_line * weights, at.by_view * weights, local)
    cost += float(np.sum(e**2))
    # Points first, then lines, as everywhere.
    rows = 3 * len(points.blocks), 4 * len(lines.blocks)
    return PictureEquations(
        0.5 * cost,
        FeatureBlocks(points.blocks, lines.blocks),
        np.concatenate([points.gradient.ravel(), lines.gradient.ravel()]),
        points.numbers + lines.numbers,
        points.number_gradient + lines.number_gradient,
        np.concatenate(
            [
                kind.coupling.reshape(count, columns.shape[1])
                for kind, count in zip((points, lines), rows, strict=True)
            ]
        ),
        residuals,
    )


class _Accumulated(NamedTuple):
    """The sums over views of the products of residuals and Jacobians of one kind of feature."""

    blocks: np.ndarray
    gradient: np.ndarray
    numbers: np.ndarray
    number_gradient: np.ndarray
    coupling: np.ndarray


def _accumulate(
    e: Float[np.ndarray, "views features 2"],
    J: Float[np.ndarray, "views features 2 n"],
    N: Float[np.ndarray, "views features 2 local"],
    local: Float[np.ndarray, "views local numbers"],
) -> _Accumulated:
    """Return the sums; local derivatives of a view are multiplied out once per view."""
    Jt = J.swapaxes(-1, -2)
    # Sum over features first, in the few local numbers of each view, then apply the chain rule.
    gram = np.einsum("vfia,vfib->vab", N, N, optimize=True)
    local_gradient = np.einsum("vfia,vfi->va", N, e)
    return _Accumulated(
        np.sum(Jt @ J, axis=0),
        np.sum(Jt @ e[..., None], axis=0)[..., 0],
        np.einsum("vai,vab,vbj->ij", local, gram, local, optimize=True),
        np.einsum("vai,va->i", local, local_gradient),
        np.einsum("vfna,vaj->fnj", Jt @ N, local, optimize=True),
    )


def _robust(
    loss: AbstractLoss | None, squared: Float[np.ndarray, "views points"]
) -> tuple[float, Float[np.ndarray, "views points"]]:
    """Return the sum of the losses, and the weights of reweighted least squares."""
    if loss is None:
        return float(squared.sum()), np.ones_like(squared)
    values, weight = map(np.asarray, _loss_and_weight(loss, to_device(squared)))
    return float(values.sum()), weight


@compiled
def _loss_and_weight(
    loss: AbstractLoss, squared: Float[Array, "views points"]
) -> tuple[Float[Array, "views points"], Float[Array, "views points"]]:
    """Return the loss of squared residuals and its derivative."""
    return jax.jvp(loss.rho, (squared,), (jnp.ones_like(squared),))


def _displaced(
    views: SeenViews,
    uncertainty: CalibrationUncertainty,
    offsets: Float[np.ndarray, "all_numbers"],
) -> tuple[SeenViews, Float[np.ndarray, "views 4 4"]]:
    """Return the camera and the poses after offsets of the calibration's numbers."""
    # Without offsets return the exact matrices, rather than a product with the identity.
    if not offsets.any():
        return views, views.camera_from_world
    # exp(Ad d) acts on the left of camera_from_world; `view_jacobian` includes the adjoints.
    change = uncertainty.view_jacobian @ offsets
    twists, camera_step = change[:, -6:], change[0, : camera_parameter_count(views)]
    return (
        views._replace(camera=moved_cameras(views.camera, camera_step)),
        host_exponentials(twists) @ views.camera_from_world,
    )
