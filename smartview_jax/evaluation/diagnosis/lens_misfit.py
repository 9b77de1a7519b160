"""What a lens model leaves over: a pattern over the picture that is the same in all views.

With a pose of its own for every view, the chain's errors are gone. Noise of pixels then has no
pattern; where neighbouring points err alike in all views, the lens is not what the model says.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ...calibration import Calibration
from ...dataset import Dataset
from ..free_poses import free_pose_predictions

DEGREE = 5
"""Of the polynomials in u and v that describe the pattern: those of common lenses and one more."""


def lens_misfit(
    calibration: Calibration, data: Dataset, used: Bool[np.ndarray, "views points"]
) -> float:
    """RMS over points of the smooth pattern that residuals have over the picture, px.

    What noise alone would put into so many coefficients is taken off; zero where that is all.

    Args:
        calibration: its camera and target scale count, its chain does not.
        data: points and pixels.
        used: which of the points that were seen to count: not those that were rejected.
    """
    data = eqx.tree_at(lambda d: d.visible, data, data.visible & jnp.asarray(used))
    predicted, valid, _ = free_pose_predictions(calibration, data)
    used = np.asarray(data.visible & valid)
    residual = np.asarray(data.pixels - predicted)[used]
    pattern = _smooth(np.asarray(predicted)[used], calibration.camera.image_size)
    count, size = pattern.shape
    free = 2 * (count - size) - 6 * int(used.any(axis=1).sum())
    if free < count:
        return 0.0
    basis, _ = np.linalg.qr(pattern)
    explained = np.sum((basis.T @ residual) ** 2)
    noise = (np.sum(residual**2) - explained) / free
    return float(np.sqrt(max(explained - 2 * size * noise, 0.0) / count))


def _smooth(
    pixels: Float[np.ndarray, "points 2"], image_size: tuple[int, int]
) -> Float[np.ndarray, "points terms"]:
    """Products of powers of u and v up to `DEGREE` in all, from -1 to 1 over the picture."""
    place = 2.0 * pixels / np.array(image_size, dtype=float) - 1.0
    powers = np.polynomial.legendre.legvander2d(place[:, 0], place[:, 1], [DEGREE, DEGREE])
    u, v = np.meshgrid(range(DEGREE + 1), range(DEGREE + 1), indexing="ij")
    return powers[:, (u + v).ravel() <= DEGREE]
