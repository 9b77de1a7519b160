"""Compare the error that a fit predicts for unseen views with its actual error on them.

The covariance of a fit and its noise model predict its error at any pose. If the actual error is
larger, the stated standard deviations are too small, whatever the reason.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...calibration import Calibration, chain_of_matrices
from ...dataset import Dataset, require_same_set_up
from ...engine import Noise, corrections_at_tool, covariance_factor
from ...geometry import host_matrices, moved_points, pose_matrices
from ...joint import JointFit, SavedEstimate
from ...robots import Command
from ...runtime.array_namespace import to_device
from ...runtime.compilation import compiled
from ..measures import ReprojectionErrors, errors_at_target, predict
from ..uncertainty import std_of, sum_of_squared_derivatives
from .held_out import FoldFit, HeldOutErrors, pool_errors, score, whole_fit


class PredictedError(NamedTuple):
    """The errors that the fits of all folds predicted for their hidden views, and the actual ones.

    Attributes:
        predicted: root of the expected squared reprojection error of every point.
        actual: the actual reprojection errors.
    """

    predicted: HeldOutErrors
    actual: HeldOutErrors

    @property
    def rms_ratio(self) -> float:
        """The actual over the predicted RMS: 1 is consistent, 2 is twice the stated uncertainty.

        It is over the points that have both, and NaN if none has.
        """
        # sqrt(sum(actual^2) / sum(predicted^2)): tiny predicted errors do not dominate.
        actual, predicted = self.actual.errors.px, self.predicted.errors.px
        both = np.isfinite(actual) & np.isfinite(predicted)
        if not both.any():
            return float("nan")
        return float(np.sqrt(np.sum(actual[both] ** 2) / np.sum(predicted[both] ** 2)))


def predicted_error(
    fold_fits: Sequence[FoldFit], data: Dataset, choose: Callable[[Any, Dataset], Any] = whole_fit
) -> PredictedError:
    """Return the errors that the fits of all folds predicted, with the actual errors.

    Args:
        fold_fits: from `fit_folds`, with the same data.
        data: all views.
        choose: function from a fit and the data to the `JointFit` in it. A fold whose fit leaves a
            parameter undetermined predicts no error, and is a failure of `predicted`.
    """
    return PredictedError(
        pool_errors(
            fold_fits, data, lambda fit: expected_reprojection_errors(choose(fit, data), data)
        ),
        score(fold_fits, data, choose),
    )


def expected_reprojection_errors(
    fit: JointFit | SavedEstimate, data: Dataset
) -> ReprojectionErrors:
    """Return the root of the expected squared reprojection error of every point seen.

    Four independent errors add up: the error of the parameters (the fit's covariance); of pixels
    about the view's best pose (the white sigma); of this best pose (the excess of the effective
    over the white sigma); and of the reported poses.

    Args:
        fit: a joint fit, or a saved one; the prediction is for views that it never used.
        data: any views. The result is infinite for unpredictable points, and NaN for points not
            seen.

    Raises:
        ValueError: the fit's data leave a parameter undetermined, or its noise leaves the poses
            free; or a fit of another mount, or of pictures of another size.
    """
    require_same_set_up("the calibration", fit.calibration, data)
    calibration, visible = fit.calibration, np.asarray(data.visible)
    _, valid, depth = predict(calibration, data.command, data.points)
    expected_square = sum(expected_squared_errors(fit, data))
    px = np.where(visible, np.where(np.asarray(valid), np.sqrt(expected_square), np.inf), np.nan)
    return errors_at_target(calibration.camera, px, depth)


class ExpectedSquaredErrors(NamedTuple):
    """The expected squared reprojection error of points, u and v together, px^2, by cause.

    Attributes:
        parameters: due to the covariance of the parameters.
        pixels: due to noise of pixels, independent and common to a view.
        poses: due to noise of the poses that the robot reports.
    """

    parameters: Float[np.ndarray, "views points"]
    pixels: Float[np.ndarray, "views points"]
    poses: Float[np.ndarray, "views points"]


def expected_squared_errors(fit: JointFit | SavedEstimate, data: Dataset) -> ExpectedSquaredErrors:
    """Return the contributions to `expected_reprojection_errors`; raises as it does."""
    calibration, noise = fit.calibration, fit.noise
    white_sigma = effective_sigma = fit.pixel_sigma
    pose_variance = np.zeros(data.visible.shape)
    if noise is not None:
        if not max(noise.translation, noise.rotation) < np.inf:
            raise ValueError(
                "the noise model leaves the robot's poses free: nothing can be predicted"
            )
        roots = to_device(_pose_noise_roots(noise, data))
        pose_variance = np.asarray(
            _pose_noise_variance(calibration, roots, data.command, data.points)
        )
        if noise.white_pixel is not None:
            white_sigma, effective_sigma = noise.white_pixel, noise.pixel
    # E|e|^2 = tr(J P J^T) + pixels + poses, for u and v together, with J the Jacobian with respect
    # to the parameters and P their covariance. std_of^2 is the diagonal of J P J^T.
    parameter_std = np.asarray(std_of(fit, _PixelFunction(data.command, data.points)))
    point_counts = np.maximum(np.asarray(data.visible).sum(axis=1, keepdims=True), 1)
    # A pose has six parameters, so six of the 2 n residuals of a view with n points have the
    # effective variance. On average over the points:
    #     2 white_sigma^2 + 6 (effective_sigma^2 - white_sigma^2) / n
    pixel_variance = (
        2.0 * white_sigma**2 + 6.0 * (effective_sigma**2 - white_sigma**2) / point_counts
    )
    return ExpectedSquaredErrors(
        np.sum(parameter_std**2, axis=-1),
        np.broadcast_to(pixel_variance, pose_variance.shape),
        pose_variance,
    )


def _pose_noise_roots(noise: Noise, data: Dataset) -> Float[np.ndarray, "views 6 6"]:
    """Return the noise of each reported pose, a twist at the tool, by six unit normal numbers."""
    tool_from_base = host_matrices(data.base_from_tool)[:, :3, :3].swapaxes(1, 2)
    return covariance_factor(noise.pose_covariances(tool_from_base))


class _PixelFunction(eqx.Module):
    """A function from calibrations to pixels of given points, zero for invalid ones.

    It is a pytree, so that it is compiled once.
    """

    command: Command
    points: Float[Array, "views points 3"]

    def __call__(self, calibration: Calibration) -> Float[Array, "views points 2"]:
        """Return the pixels under a calibration."""
        pixels, valid = calibration.project(self.command, self.points)
        return jnp.where(valid[..., None], pixels, 0.0)


@compiled
def _pose_noise_variance(
    calibration: Calibration,
    roots: Float[Array, "views 6 6"],
    command: Command,
    points: Float[Array, "views points 3"],
) -> Float[Array, "views points"]:
    """Return the variance of pixels, u and v together, due to white noise of the reported poses.

    `roots` are the noise of each pose by six independent numbers of variance one.
    """
    error, command = calibration.robot_error, calibration.with_bases(command)
    # The noise is added to the smooth correction, so the corrected pose is perturbed.
    poses = command.base_from_tool if error is None else error.actual_pose(command)

    def pixels(correction: Float[Array, "6"]) -> Float[Array, "views points 2"]:
        # tool_from_base = exp(correction) @ reported, so its inverse has exp(-correction) behind.
        twists = -jnp.broadcast_to(roots, (*poses.get_batch_axes(), 6, 6)) @ correction
        noisy = pose_matrices(poses) @ corrections_at_tool(command, twists)
        camera_from_world = chain_of_matrices(
            calibration.camera_from_mount, calibration.holder_from_world, calibration.mount, noisy
        )
        in_camera = moved_points(camera_from_world, calibration.true_points(points))
        projected, valid = calibration.camera.project(in_camera)
        return jnp.where(valid[..., None], projected, 0.0)

    # sum_k (d(pixel) / d(correction_k))^2, at zero.
    return jnp.sum(sum_of_squared_derivatives(pixels, jnp.eye(6)), axis=-1)
