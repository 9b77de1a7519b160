"""Turn a message of a known camera (camera_info) into a file that `read_camera` reads."""

from typing import Any

import numpy as np

from ..export_text import OpenCVDistortion, camera_info_text

CAMERA_FILE = "camera_info.yaml"
"""The name of the file with the known camera."""

_COUNTS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
"""Number of coefficients of ROS's lens models that are read."""


def camera_text(
    message: Any, image_size: tuple[int, int], rectified: bool
) -> tuple[str | None, str]:
    """Return the text of the camera's file, None if there is no calibrated camera, and a note.

    Args:
        message: a `sensor_msgs/CameraInfo`.
        image_size: width and height of the pictures, px.
        rectified: whether the pictures are rectified: their camera has no distortion, and its
            numbers are in the projection matrix P.
    """
    K = np.asarray(message.k if hasattr(message, "k") else message.K, dtype=float).reshape(3, 3)
    P = np.asarray(message.p if hasattr(message, "p") else message.P, dtype=float).reshape(3, 4)
    D = np.asarray(message.d if hasattr(message, "d") else message.D, dtype=float)
    size = (int(message.width), int(message.height))
    matrix = P[:, :3] if rectified else K
    if not matrix[0, 0] > 0.0:
        return None, "camera_info: not calibrated (its focal length is 0)"
    if size != image_size:
        return None, (
            f"camera_info: for pictures of {size[0]} x {size[1]} px, but these have "
            f"{image_size[0]} x {image_size[1]}: not used"
        )
    model = str(message.distortion_model) or "plumb_bob"
    if rectified:
        lens: OpenCVDistortion | None = OpenCVDistortion("plumb_bob", (0.0,) * 5, 0.0)
    else:
        lens = _distortion(model, D)
    if lens is None:
        return None, f"camera_info: {model} with {len(D)} coefficients is not read: not used"
    numbers = {
        "image_size": size,
        "alpha_u": matrix[0, 0],
        "alpha_v": matrix[1, 1],
        "u0": matrix[0, 2],
        "v0": matrix[1, 2],
    }
    kind = "rectified, without distortion" if rectified else lens.model
    return camera_info_text(numbers, lens, "camera"), f"camera_info: {CAMERA_FILE} ({kind})"


def _distortion(model: str, coefficients: np.ndarray) -> OpenCVDistortion | None:
    """Return the lens with ROS's number of coefficients; None if there is no such lens."""
    if model not in _COUNTS:
        return None
    count = _COUNTS[model]
    # Some drivers state zeros of longer models, others nothing for a lens without distortion.
    if np.any(coefficients[count:]) or not np.all(np.isfinite(coefficients)):
        return None
    padded = np.zeros(count)
    padded[: min(count, len(coefficients))] = coefficients[:count]
    return OpenCVDistortion(model, tuple(padded.tolist()), 0.0)
