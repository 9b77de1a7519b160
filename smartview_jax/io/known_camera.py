"""Read a known camera from a file in any format that is supported."""

import re
from collections.abc import Sequence
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
    if _is_camchain(text):
        cameras = read_kalibr_cameras(path)
        if len(cameras) != 1:
            raise ValueError(f"{path}: expected one camera, found {', '.join(cameras)}")
        return next(iter(cameras.values()))
    return read_opencv_camera(path)


def read_cameras(path: str | Path, names: Sequence[str]) -> dict[str, Camera]:
    """Read known cameras of a rig, by name.

    Args:
        path: folder with one file for each known camera, called as the camera is, such as
            `left.yaml`, in any format of `read_camera`; or Kalibr's camchain of all cameras. The
            entries of a camchain that are not called as the cameras are, such as cam0 and cam1, are
            the cameras in their order.
        names: of the rig's cameras, in their order.

    Raises:
        FileNotFoundError: the path is missing.
        ValueError: no file for any camera, two for one, a file with another name while a camera
            has none, a camchain of another number of cameras, or a file that cannot be
            read; the message names it.
    """
    path = Path(path)
    if path.is_dir():
        present = sorted(path.iterdir())
        files = {name: [file for file in present if file.stem == name] for name in names}
        for name, own in files.items():
            if len(own) > 1:
                found = ", ".join(file.name for file in own)
                raise ValueError(f"{path}: expected one file for camera {name!r}, found {found}")
        if not any(files.values()):
            found = ", ".join(file.name for file in present) or "nothing"
            raise ValueError(
                f"{path}: expected a file for a camera, such as {names[0]}.yaml; found {found}"
            )
        if lacking := [name for name, own in files.items() if not own]:
            _refuse_misnamed([file for file in present if file.stem not in names], lacking)
        return {name: read_camera(own[0]) for name, own in files.items() if own}
    if not _is_camchain(read_text(path)):
        raise ValueError(
            f"{path}: expected a folder with a file for each camera, such as {names[0]}.yaml, or "
            "Kalibr's camchain.yaml"
        )
    cameras = read_kalibr_cameras(path)
    if set(cameras) <= set(names):
        return cameras
    # In their order only if no name is shared: cam1 of the file would become another camera.
    if len(cameras) != len(names) or set(cameras) & set(names):
        raise ValueError(
            f"{path}: expected {len(names)} cameras, for {', '.join(names)}; found "
            f"{', '.join(cameras)}"
        )
    return dict(zip(names, cameras.values(), strict=True))


def _refuse_misnamed(others: Sequence[Path], lacking: Sequence[str]) -> None:
    """Raise a ValueError that names a camera's file whose name is no camera of the rig.

    Args:
        others: files whose names are no camera's.
        lacking: names of the cameras without a file.
    """
    for file in others:
        try:
            read_camera(file)
        except (ValueError, OSError):
            # It is no camera's: a report, or where two arms are.
            continue
        raise ValueError(
            f"{file}: it has a camera, but no camera of the rig is called {file.stem!r}; call it "
            f"{' or '.join(f'{name}{file.suffix}' for name in lacking)}, or take it away"
        )


def _is_camchain(text: str) -> bool:
    """Return whether a text is a camchain of Kalibr, by its entries cam0, cam1, ..."""
    return re.search(r"^cam\d+:", text, re.MULTILINE) is not None
