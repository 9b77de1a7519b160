"""Read a known camera from a file in any format that is supported."""

import re
from pathlib import Path

from ..calibration import Calibration
from ..cameras import Camera
from ..files import read_text
from .kalibr_camera import read_kalibr_cameras
from .mrcal_camera import read_mrcal_camera
from .opencv_camera import read_opencv_camera
from .visp import read_visp_camera


def read_camera(path: str | Path) -> Camera:
    """Read a camera from a calibration.yaml, or a file of OpenCV, ROS, Kalibr, mrcal or ViSP.

    Args:
        path: of the file; the format is recognised from its content.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: a wrong or missing entry, or a camchain with several cameras; the message names
            it and the file.
    """
    text = read_text(path)
    if text.lstrip().startswith("<"):
        return read_visp_camera(path)
    # The first entry of every calibration file, YAML or JSON.
    if "smartview_calibration" in text:
        return Calibration.load(path).camera
    if "LENSMODEL_" in text:
        return read_mrcal_camera(path)
    if re.search(r"^cam\d+:", text, re.MULTILINE):
        cameras = read_kalibr_cameras(path)
        if len(cameras) != 1:
            raise ValueError(f"{path}: expected one camera, found {', '.join(cameras)}")
        return next(iter(cameras.values()))
    return read_opencv_camera(path)
