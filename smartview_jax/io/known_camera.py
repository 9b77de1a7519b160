"""Read a camera that is known already, from whatever file its maker or an earlier run wrote."""

from pathlib import Path

from ..calibration import Calibration
from ..cameras import Camera
from ..files import read_text
from .opencv_camera import read_opencv_camera
from .visp import read_visp_camera


def read_camera(path: str | Path) -> Camera:
    """Read a camera from a calibration.yaml, a YAML of OpenCV or ROS, or an XML of ViSP.

    Args:
        path: of the file; its content tells which of them it is.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: naming the file and the entry that is wrong or missing.
    """
    text = read_text(path)
    if text.lstrip().startswith("<"):
        return read_visp_camera(path)
    # The first entry of every calibration file, YAML or JSON.
    if "smartview_calibration" in text:
        return Calibration.load(path).camera
    return read_opencv_camera(path)
