"""Measure the misfit of a lens model: a pattern of residuals that is the same in all views.

With a free pose for every view, the errors of the chain vanish. Pixel noise has no pattern; similar
residuals of neighbouring points in all views mean that the lens model is wrong.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ...calibration import Calibration
from ...dataset import Dataset
from ..free_poses import free_pose_predictions

POLYNOMIAL_DEGREE = 5
"""The degree of the polynomials in u and v of the pattern: one more than common lens models'."""


def lens_misfit(
    calibration: Calibration, data: Dataset, used: Bool[np.ndarray, "views points"]
) -> float:
    """Return the RMS over points of the smooth pattern of residuals over the image, px.

    The expected contribution of noise is subtracted; zero if nothing remains, or if there are too
    few points to estimate the noise.

    Args:
        calibration: its camera and target scale are used, its chain only for initial poses.
        data: points and pixels.
        used: which of the visible points to use; rejected points are excluded.
    """
    data = eqx.tree_at(lambda d: d.visible, data, data.visible & jnp.asarray(used))
    predicted, valid, _ = free_pose_predictions(calibration, data)
    used = np.asarray(data.visible & valid)
    residual = np.asarray(data.pixels - predicted)[used]
    design = _legendre_basis(np.asarray(predicted)[used], calibration.camera.image_size)
    count, term_count = design.shape
    # Degrees of freedom: two per point, less two per polynomial and six per view's pose.
    degrees_of_freedom = 2 * (count - term_count) - 6 * int(used.any(axis=1).sum())
    if degrees_of_freedom < count:
        return 0.0
    # E|Q^T r|^2 = |pattern|^2 + 2 term_count noise_variance, with Q an orthonormal basis of the
    # polynomials and noise_variance = (|r|^2 - |Q^T r|^2) / degrees_of_freedom.
    orthonormal, _ = np.linalg.qr(design)
    explained_sum_of_squares = np.sum((orthonormal.T @ residual) ** 2)
    noise_variance = (np.sum(residual**2) - explained_sum_of_squares) / degrees_of_freedom
    return float(
        np.sqrt(max(explained_sum_of_squares - 2 * term_count * noise_variance, 0.0) / count)
    )


def _legendre_basis(
    pixels: Float[np.ndarray, "points 2"], image_size: tuple[int, int]
) -> Float[np.ndarray, "points terms"]:
    """Return products of Legendre polynomials of u and v up to total degree `POLYNOMIAL_DEGREE`.

    Both are scaled to -1..1 on the image.
    """
    normalised = 2.0 * pixels / np.array(image_size, dtype=float) - 1.0
    products = np.polynomial.legendre.legvander2d(
        normalised[:, 0], normalised[:, 1], [POLYNOMIAL_DEGREE, POLYNOMIAL_DEGREE]
    )
    # `legvander2d` limits the degree in u and in v each; products of a higher total are left out.
    degrees = range(POLYNOMIAL_DEGREE + 1)
    u_degree, v_degree = np.meshgrid(degrees, degrees, indexing="ij")
    return products[:, (u_degree + v_degree).ravel() <= POLYNOMIAL_DEGREE]
