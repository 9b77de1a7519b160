"""Read and write cameramodel files of mrcal.

Their content is a Python literal, which is YAML as well, apart from bytes. It is read as YAML,
whose reader refuses repeated keys and deep nesting.
"""

import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..calibration import Calibration
from ..cameras import Camera, Pinhole
from ..files import parse_yaml, read_text
from ..geometry import host_matrices
from .export import opencv_coefficients
from .opencv_camera import opencv_lens


def read_mrcal_camera(path: str | Path) -> Camera:
    """Read the camera in a cameramodel file of mrcal.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: a wrong or missing entry, or a lens that is not OpenCV's, which
            `mrcal-convert-lensmodel` converts; the message names it and the file.
    """
    from ..schemas.calibration import PINHOLE_SCHEMA
    from ..schemas.external_formats import MRCAL_CAMERA_SCHEMA
    from ..schemas.validation import validate_content

    # The data of the calibration, as bytes in base 85, are the only part that is not YAML.
    text = re.sub(r"'optimization_inputs':\s*b'[^']*',?", "", read_text(path))
    content = validate_content(parse_yaml(text, Path(path)), MRCAL_CAMERA_SCHEMA, path)
    pinhole, coefficients = content.intrinsics[:4], np.array(content.intrinsics[4:])
    numbers = dict(zip(("alpha_u", "alpha_v", "u0", "v0"), pinhole, strict=True))
    validate_content(numbers, PINHOLE_SCHEMA, f"{path}: intrinsics")
    lens = opencv_lens(coefficients, None, str(path)) if len(coefficients) else Pinhole()
    width, height = content.imagersize
    return Camera(**numbers, lens=lens, image_size=(width, height))


def mrcal_cameramodel(calibration: Calibration) -> str:
    """Return a cameramodel file of mrcal with the camera and its pose on the mount.

    The extrinsics are the hand-eye transform, `camera_from_tool` (`camera_from_base` for a fixed
    camera): mrcal's reference frame is the mount.

    Raises:
        ValueError: a fisheye, which mrcal has no model of.
    """
    camera, lens = calibration.camera, opencv_coefficients(calibration.camera)
    if lens.model == "equidistant":
        raise ValueError(f"mrcal has no lens like {camera.lens!r}: calibrate with lens='opencv8'")
    coefficients = [float(x) for x in lens.coefficients]
    intrinsics = [float(x) for x in (camera.alpha_u, camera.alpha_v, camera.u0, camera.v0)]
    matrix = host_matrices(calibration.camera_from_mount)
    turn = Rotation.from_matrix(matrix[:3, :3]).as_rotvec()
    entries = {
        "lensmodel": f"LENSMODEL_OPENCV{len(coefficients)}",
        "intrinsics": intrinsics + coefficients,
        "extrinsics": [float(x) for x in (*turn, *matrix[:3, 3])],
        "imagersize": list(camera.image_size),
    }
    lines = "".join(f"    {name!r}: {value!r},\n" for name, value in entries.items())
    return f"{{\n{lines}}}\n"
