"""Measure what a lens model does not describe: a pattern over the image, the same in all views.

With a pose of its own for every view, the chain's errors are gone. Noise of pixels has no pattern;
if neighbouring points have similar errors in all views, the lens is not as its model says.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ...calibration import Calibration
from ...dataset import Dataset
from ..free_poses import free_pose_predictions

DEGREE = 5
"""The degree of the polynomials in u and v that describe the pattern: common lenses', plus one."""


def lens_misfit(
    calibration: Calibration, data: Dataset, used: Bool[np.ndarray, "views points"]
) -> float:
    """Return the RMS over points of the smooth pattern of residuals over the image, px.

    The contribution that noise alone would make to this many coefficients is subtracted; zero if
    nothing remains.

    Args:
        calibration: its camera and target scale matter, its chain does not.
        data: points and pixels.
        used: which of the visible points to use; rejected points are excluded.
    """
    data = eqx.tree_at(lambda d: d.visible, data, data.visible & jnp.asarray(used))
    predicted, valid, _ = free_pose_predictions(calibration, data)
    used = np.asarray(data.visible & valid)
    residual = np.asarray(data.pixels - predicted)[used]
    pattern = _smooth(np.asarray(predicted)[used], calibration.camera.image_size)
    count, size = pattern.shape
    # Degrees of freedom: two residuals per point, less two per polynomial and six per view's pose.
    free = 2 * (count - size) - 6 * int(used.any(axis=1).sum())
    if free < count:
        return 0.0
    # E|Q^T r|^2 = |pattern|^2 + 2 size sigma^2, with Q an orthonormal basis of the polynomials and
    # sigma^2 = (|r|^2 - |Q^T r|^2) / free the noise.
    basis, _ = np.linalg.qr(pattern)
    explained = np.sum((basis.T @ residual) ** 2)
    noise = (np.sum(residual**2) - explained) / free
    return float(np.sqrt(max(explained - 2 * size * noise, 0.0) / count))


def _smooth(
    pixels: Float[np.ndarray, "points 2"], image_size: tuple[int, int]
) -> Float[np.ndarray, "points terms"]:
    """Return products of Legendre polynomials of u and v up to total degree `DEGREE`.

    Both are scaled to -1..1 on the image.
    """
    place = 2.0 * pixels / np.array(image_size, dtype=float) - 1.0
    powers = np.polynomial.legendre.legvander2d(place[:, 0], place[:, 1], [DEGREE, DEGREE])
    u, v = np.meshgrid(range(DEGREE + 1), range(DEGREE + 1), indexing="ij")
    return powers[:, (u + v).ravel() <= DEGREE]
