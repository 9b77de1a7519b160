"""Turn the brightness on a sensor into a picture: exposure, blur, noise, 8 bits."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8


def sensor_picture(
    brightness: Float[np.ndarray, "rows columns"],
    *,
    blur: float = 0.7,
    noise: float = 1.0,
    exposure: float = 1.0,
    seed: int = 0,
) -> UInt8[np.ndarray, "rows columns"]:
    """Return the picture that a sensor takes of the brightness averaged over each pixel.

    Args:
        brightness: grey levels at an exposure of one; values above 255 saturate.
        blur: standard deviation of the lens's blur, px.
        noise: standard deviation of the sensor's noise, grey levels.
        exposure: factor by which the brightness is multiplied.
        seed: seed of the noise.
    """
    picture = np.asarray(brightness, dtype=float)
    if blur > 0.0:
        picture = cv2.GaussianBlur(picture, (0, 0), blur)
    picture = exposure * picture
    picture = picture + noise * np.random.default_rng(seed).standard_normal(picture.shape)
    # Saturation and rounding come last, as in a converter.
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)
