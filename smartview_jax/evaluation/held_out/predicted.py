"""Compare the error that a fit predicts for unseen views with the error that it has there.

A fit states how well it knows its parameters, and how large the errors of pixels and poses are.
Together these predict its error at any pose. If the actual error is larger, its standard deviations
are too small, whatever the reason.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ...calibration import Calibration
from ...compilation import compiled
from ...dataset import Dataset
from ...joint import JointFit
from ...robots import Command
from ..measures import Deviations, at_target, predict
from ..uncertainty import std_of, sum_of_squares
from .held_out import HeldOut, Refit, pooled, score, whole


class Foretold(NamedTuple):
    """The errors that the fits of all folds predicted for their hidden views, and the actual ones.

    Attributes:
        predicted: root of the expected squared reprojection error of every point.
        realised: the actual reprojection errors.
    """

    predicted: HeldOut
    realised: HeldOut

    @property
    def ratio(self) -> float:
        """The actual over the predicted RMS: 1 is consistent, 2 is twice the stated uncertainty."""
        return _ratio(self.realised.deviations.px, self.predicted.deviations.px)

    @property
    def per_view(self) -> Float[np.ndarray, "views"]:
        """The same ratio for every view; NaN for one that was not held out."""
        return np.array([self._of([k]) for k in range(len(self.realised.deviations.px))])

    @property
    def per_fold(self) -> Float[np.ndarray, "folds"]:
        """The same ratio for every fold; NaN for one that failed."""
        return np.array([self._of(list(fold)) for fold in self.realised.folds])

    def _of(self, views: list[int]) -> float:
        """Return the ratio for some views."""
        return _ratio(self.realised.deviations.px[views], self.predicted.deviations.px[views])


def _ratio(realised: np.ndarray, predicted: np.ndarray) -> float:
    """Return the ratio of realised to predicted RMS over points that have both; NaN if none has."""
    # sqrt(sum(realised^2) / sum(predicted^2)), pooled so that tiny predicted errors do not
    # dominate.
    both = np.isfinite(realised) & np.isfinite(predicted)
    if not both.any():
        return float("nan")
    return float(np.sqrt(np.sum(realised[both] ** 2) / np.sum(predicted[both] ** 2)))


def foretold(
    refits: Sequence[Refit], data: Dataset, choose: Callable[[Any, Dataset], Any] = whole
) -> Foretold:
    """Return the errors that the fits of all folds predicted, with the actual errors.

    Args:
        refits: from `refit`, with the same data.
        data: all views.
        choose: function from a fit and the data to the `JointFit` in it. A fold whose fit leaves a
            parameter undetermined predicts no error, and is a failure of `predicted`.
    """
    return Foretold(
        pooled(refits, data, lambda fit: predicted_deviations(choose(fit, data), data)),
        score(refits, data, choose),
    )


def predicted_deviations(fit: JointFit, data: Dataset) -> Deviations:
    """Return the root of the expected squared reprojection error of every point seen.

    Under the model four independent errors add up: of the parameters, by the fit's covariance; of
    pixels about their view's own best pose, by the white sigma; of that pose, by the excess of the
    effective over the white sigma; and independent errors of the poses that the robot reports.

    Args:
        fit: a joint fit; its parameters' uncertainty is that of views it never used.
        data: any views. Points that cannot be predicted are infinite, those not seen NaN.

    Raises:
        ValueError: the fit's data leave a parameter undetermined, or its noise leaves the poses
            free.
    """
    calibration, visible = fit.calibration, np.asarray(data.visible)
    _, valid, depth = predict(calibration, data.command, data.points)
    square = sum(expected_squares(fit, data))
    px = np.where(visible, np.where(np.asarray(valid), np.sqrt(square), np.inf), np.nan)
    return at_target(calibration.camera, px, depth)


class Squares(NamedTuple):
    """The expected squared reprojection error of points, u and v together, px^2, by cause.

    Attributes:
        parameters: due to the covariance of the parameters.
        pixels: due to noise of pixels, independent and common to a view.
        poses: due to noise of the poses that the robot reports.
    """

    parameters: Float[np.ndarray, "views points"]
    pixels: Float[np.ndarray, "views points"]
    poses: Float[np.ndarray, "views points"]


def expected_squares(fit: JointFit, data: Dataset) -> Squares:
    """Return the squared parts of `predicted_deviations`; raises as it does."""
    calibration, noise = fit.calibration, fit.noise
    white = effective = fit.pixel_sigma
    by_poses = np.zeros(data.visible.shape)
    if noise is not None:
        if not max(noise.translation, noise.rotation) < np.inf:
            raise ValueError("a robot whose poses may be anywhere leaves nothing to predict")
        sizes = jnp.repeat(jnp.array([noise.translation, noise.rotation]), 3)
        by_poses = np.asarray(_by_poses(calibration, sizes, data.command, data.points))
        if noise.white_pixel is not None:
            white, effective = noise.white_pixel, noise.pixel
    # E|e|^2 = tr(J P J^T) + pixels + poses, for u and v together; J by the parameters, P their
    # covariance. std_of gives the diagonal of J P J^T.
    known = np.asarray(std_of(fit, _Pixels(data.command, data.points)))
    seen = np.maximum(np.asarray(data.visible).sum(axis=1, keepdims=True), 1)
    # A pose has six parameters, so of the view's 2 n residuals six have the effective variance,
    # spread over n points: 2 white^2 + 6 (effective^2 - white^2) / n.
    by_pixels = 2.0 * white**2 + 6.0 * (effective**2 - white**2) / seen
    return Squares(np.sum(known**2, axis=-1), np.broadcast_to(by_pixels, by_poses.shape), by_poses)


class _Pixels(eqx.Module):
    """A function from calibrations to pixels of given points, zero where there are none.

    It is a pytree, so that it is compiled once.
    """

    command: Command
    points: Float[Array, "views points 3"]

    def __call__(self, calibration: Calibration) -> Float[Array, "views points 2"]:
        """Return the pixels under a calibration."""
        pixels, valid = calibration.project(self.command, self.points)
        return jnp.where(valid[..., None], pixels, 0.0)


@compiled
def _by_poses(
    calibration: Calibration,
    sizes: Float[Array, "6"],
    command: Command,
    points: Float[Array, "views points 3"],
) -> Float[Array, "views points"]:
    """Return the variance of pixels, u and v together, due to white noise of the reported poses."""
    error = calibration.robot_error
    # The noise is on top of the smooth correction, so the corrected pose is perturbed.
    poses = command.base_from_tool if error is None else error.true_pose(command)

    def pixels(correction: Float[Array, "6"]) -> Float[Array, "views points 2"]:
        each = jnp.broadcast_to(-correction, (*poses.get_batch_axes(), 6))
        found, valid = calibration.project(poses @ SE3.exp(each), points, corrected=False)
        return jnp.where(valid[..., None], found, 0.0)

    # sum_k (sigma_k d(pixel) / d(twist_k))^2, at zero.
    return jnp.sum(sum_of_squares(pixels, jnp.diag(sizes)), axis=-1)
