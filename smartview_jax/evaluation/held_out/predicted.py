"""The error that a fit expects of itself on views it never saw, beside the one that it has there.

A fit states how well it knows its parameters, and how large the errors of pixels and of poses are.
Together they say how far off it should be from any pose. Where it is farther off than that, its
standard deviations are too small, whatever the reason.
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
    """What the fits of all folds expected of the views they never saw, and what came.

    Attributes:
        predicted: root of the expected squared deviation of every point, as deviations.
        realised: the deviations.
    """

    predicted: HeldOut
    realised: HeldOut

    @property
    def ratio(self) -> float:
        """Realised over predicted RMS: 1 is honest, 2 is twice as far off as the fits believed."""
        return _ratio(self.realised.deviations.px, self.predicted.deviations.px)

    @property
    def per_view(self) -> Float[np.ndarray, "views"]:
        """The same of every view; NaN for one that was not held out."""
        return np.array([self._of([k]) for k in range(len(self.realised.deviations.px))])

    @property
    def per_fold(self) -> Float[np.ndarray, "folds"]:
        """The same of every fold; NaN for one that failed."""
        return np.array([self._of(list(fold)) for fold in self.realised.folds])

    def _of(self, views: list[int]) -> float:
        return _ratio(self.realised.deviations.px[views], self.predicted.deviations.px[views])


def _ratio(realised: np.ndarray, predicted: np.ndarray) -> float:
    both = np.isfinite(realised) & np.isfinite(predicted)
    if not both.any():
        return float("nan")
    return float(np.sqrt(np.sum(realised[both] ** 2) / np.sum(predicted[both] ** 2)))


def foretold(
    refits: Sequence[Refit], data: Dataset, choose: Callable[[Any, Dataset], Any] = whole
) -> Foretold:
    """What the fits of all folds expected, beside what came.

    Args:
        refits: from `refit`, with the same data.
        data: all views.
        choose: from a fit and the data to the `JointFit` in it. A fold whose fit leaves something
            open expects nothing in particular, and is a failure of `predicted`.
    """
    return Foretold(
        pooled(refits, data, lambda fit: predicted_deviations(choose(fit, data), data)),
        score(refits, data, choose),
    )


def predicted_deviations(fit: JointFit, data: Dataset) -> Deviations:
    """Root of the expected squared deviation of every point that was seen, if the fit is right.

    Four independent errors add up: of the parameters, by the fit's covariance; of pixels about
    their view's own best pose, by the white sigma; of that pose, by what the effective sigma is
    larger; and of the poses that the robot reports, each by itself.

    Args:
        fit: a joint fit; its parameters' uncertainty is that of views it never saw.
        data: any views. Points that cannot be predicted are infinite, those not seen NaN.

    Raises:
        ValueError: the fit's data leave something open, or its noise leaves the poses open.
    """
    calibration, visible = fit.calibration, np.asarray(data.visible)
    _, valid, depth = predict(calibration, data.command, data.points)
    square = sum(expected_squares(fit, data))
    px = np.where(visible, np.where(np.asarray(valid), np.sqrt(square), np.inf), np.nan)
    return at_target(calibration.camera, px, depth)


class Squares(NamedTuple):
    """Expected squared deviation of points, u and v together, px^2, by what causes it.

    Attributes:
        parameters: what the fit does not know of its parameters.
        pixels: noise of pixels, each by itself and a view's together.
        poses: noise of the poses that the robot reports.
    """

    parameters: Float[np.ndarray, "views points"]
    pixels: Float[np.ndarray, "views points"]
    poses: Float[np.ndarray, "views points"]


def expected_squares(fit: JointFit, data: Dataset) -> Squares:
    """The parts of `predicted_deviations`, squared; raises as there."""
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
    known = np.asarray(std_of(fit, _Pixels(data.command, data.points)))
    seen = np.maximum(np.asarray(data.visible).sum(axis=1, keepdims=True), 1)
    # A pose has six numbers; of the view's 2 n pixels they carry six, with the larger sigma.
    by_pixels = 2.0 * white**2 + 6.0 * (effective**2 - white**2) / seen
    return Squares(np.sum(known**2, axis=-1), np.broadcast_to(by_pixels, by_poses.shape), by_poses)


class _Pixels(eqx.Module):
    """Pixels by calibration; zero where there are none. A pytree, so that it is compiled once."""

    command: Command
    points: Float[Array, "views points 3"]

    def __call__(self, calibration: Calibration) -> Float[Array, "views points 2"]:
        pixels, valid = calibration.project(self.command, self.points)
        return jnp.where(valid[..., None], pixels, 0.0)


@compiled
def _by_poses(
    calibration: Calibration,
    sizes: Float[Array, "6"],
    command: Command,
    points: Float[Array, "views points 3"],
) -> Float[Array, "views points"]:
    """Variance of pixels, u and v together, by white noise of the reported poses."""
    error = calibration.robot_error
    poses = command.base_from_tool if error is None else error.true_pose(command)

    def pixels(correction: Float[Array, "6"]) -> Float[Array, "views points 2"]:
        each = jnp.broadcast_to(-correction, (*poses.get_batch_axes(), 6))
        found, valid = calibration.project(poses @ SE3.exp(each), points, corrected=False)
        return jnp.where(valid[..., None], found, 0.0)

    return jnp.sum(sum_of_squares(pixels, jnp.diag(sizes)), axis=-1)
