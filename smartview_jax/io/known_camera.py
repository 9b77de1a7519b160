"""Read a known camera from a file in any format that is supported."""

from pathlib import Path

from ..calibration import Calibration
from ..cameras import Camera
from ..files import read_text
from .opencv_camera import read_opencv_camera
from .visp import read_visp_camera


def read_camera(path: str | Path) -> Camera:
    """Read a camera from a calibration.yaml, a YAML of OpenCV or ROS, or an XML of ViSP.

    Args:
        path: of the file; the format is recognised from its content.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: a wrong or missing entry; the message names it and the file.
    """
    text = read_text(path)
    if text.lstrip().startswith("<"):
        return read_visp_camera(path)
    # The first entry of every calibration file, YAML or JSON.
    if "smartview_calibration" in text:
        return Calibration.load(path).camera
    return read_opencv_camera(path)
