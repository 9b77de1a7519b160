"""Read the cameras of Kalibr's camchain.yaml; `export` writes it.

Kalibr's distortion models are OpenCV's: `radtan` has k1, k2, p1, p2, and `equidistant` is the
fisheye with k1, k2, k3, k4.
"""

from pathlib import Path

import numpy as np

from ..cameras import Camera, Pinhole
from ..files import read_yaml
from .opencv_camera import opencv_lens


def read_kalibr_cameras(path: str | Path) -> dict[str, Camera]:
    """Read the cameras in a camchain of Kalibr, by name (`cam0`, `cam1`, ...).

    The transforms between the cameras, and to an IMU, are not read.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: a wrong or missing entry, or a model other than pinhole with radtan, equidistant
            or no distortion; the message names it and the file.
    """
    from ..schemas.calibration import PINHOLE_SCHEMA
    from ..schemas.external_formats import KALIBR_CAMCHAIN_SCHEMA
    from ..schemas.validation import validate_content

    cameras = {}
    for name, entry in validate_content(read_yaml(path), KALIBR_CAMCHAIN_SCHEMA, path).items():
        numbers = dict(zip(("alpha_u", "alpha_v", "u0", "v0"), entry.intrinsics, strict=True))
        validate_content(numbers, PINHOLE_SCHEMA, f"{path}: {name}")
        coefficients = np.array(entry.distortion_coeffs)
        model = entry.distortion_model
        lens = opencv_lens(coefficients, model, str(path)) if model != "none" else Pinhole()
        width, height = entry.resolution
        cameras[name] = Camera(**numbers, lens=lens, image_size=(width, height))
    return cameras
