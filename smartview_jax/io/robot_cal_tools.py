"""Folders of robot_cal_tools and industrial_calibration: `cal_data.yaml`, poses, `target.yaml`."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ..dataset import Dataset
from ..files import read_yaml
from ..geometry import pose_codec
from ..targets import AbstractTarget, CircleGrid
from .pictures import from_pictures

DATA_FILE = "cal_data.yaml"
_POSE_KEYS = ("x", "y", "z", "qx", "qy", "qz", "qw")


def import_robot_cal_tools(
    folder: str | Path,
    mount: str = "eye_in_hand",
    bad_views: str = "raise",
    progress: Callable[[str], None] | None = None,
) -> Dataset:
    """A data set from a folder with a modified circle grid.

    A view is named by its picture's file, not by its place in `cal_data.yaml`, whose order is that
    of the alphabet (0, 1, 10, ...).

    Args:
        folder: with `cal_data.yaml`, `target.yaml`, and what they name.
        mount: where the camera is; the folder does not say.
        bad_views: as in `load_dataset`.
        progress: told what is being done.
    """
    folder = Path(folder)
    entries = _entries(folder / DATA_FILE)
    views = [Path(image).stem for image, _ in entries]
    rows = np.stack([_pose(folder / pose) for _, pose in entries])
    return from_pictures(
        {view: [folder / image] for view, (image, _) in zip(views, entries, strict=True)},
        pose_codec("quaternion_xyzw").decode(rows, labels=views),
        _target(folder / "target.yaml"),
        mount,
        bad_views=bad_views,
        progress=progress,
    )


def _entries(path: Path) -> list[tuple[str, str]]:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    if not isinstance(content, list) or not content:
        raise ValueError(f"{path}: expected a list of poses and images")
    for entry in content:
        if not isinstance(entry, dict) or not {"pose", "image"} <= set(entry):
            raise ValueError(f"{path}: expected entries with 'pose' and 'image', found {entry!r}")
    entries = [(entry["image"], entry["pose"]) for entry in content]
    # Names that are numbers in the order of numbers, whatever the list's own order.
    return sorted(entries, key=lambda e: (len(Path(e[0]).stem), e[0]))


def _pose(path: Path) -> np.ndarray:
    content = read_yaml(path)
    missing = [key for key in _POSE_KEYS if key not in content]
    if missing:
        raise ValueError(f"{path}: entry {', '.join(missing)} is missing")
    return np.array([float(content[key]) for key in _POSE_KEYS])


def _target(path: Path) -> AbstractTarget:
    finder: dict[str, Any] = read_yaml(path).get("target_finder", {})
    kind = str(finder.get("type", ""))
    if "ModifiedCircleGrid" not in kind:
        raise ValueError(f"{path}: expected a modified circle grid, found {kind!r}")
    return CircleGrid(
        int(finder["rows"]), int(finder["cols"]), float(finder["spacing"]), origin_mark=True
    )
