"""The data-set folder: `dataset.yaml`, `poses.csv`, `images/` and cached detections.

    smartview_dataset: 1
    camera: {image_size: [640, 480]}
    target: {kind: circle_grid, rows: 10, columns: 10, spacing: 0.0254}
    mount: eye_in_hand
    poses: {file: poses.csv, codec: quaternion_xyzw, length_unit: m, angle_unit: rad,
            direction: base_from_tool}
    pictures: {pattern: "images/{view}.png"}

`poses.csv` has a column `view` and the codec's columns; `{view}` in the pattern is that name, and
`{height}` the number of the height for a board at several heights. In place of poses, or beside
them, there may be joints (see `joints.py`). Pictures, poses and joints are paired by view, never by
position. Where the pattern looks the same when turned, `base_from_world` (`tool_from_world` for a
camera beside the arm) says roughly how the target stands (see `rough_pose.py`).
"""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxlie import SE3

from ..calibration import mount_frames
from ..dataset import Dataset
from ..files import dump_yaml, read_yaml, write_atomically
from ..geometry import PoseLike, pose_codec
from ..targets import AbstractTarget, StackedTarget, target_from_dict, target_to_dict
from .commands import read_commands
from .detections import DETECTIONS, read_detections, write_detections
from .joints import write_joints
from .pictures import from_pictures, refuse_strays
from .rough_pose import read_rough_pose
from .tables import write_table

FORMAT_VERSION = 1
DESCRIPTION = "dataset.yaml"


def load_folder(
    folder: Path,
    bad_views: str = "raise",
    progress: Callable[[str], None] | None = None,
    keep_detections: bool = True,
    holder_from_world: PoseLike | None = None,
) -> Dataset:
    """A data set from a folder with a `dataset.yaml`; see `load_dataset`."""
    where = folder / DESCRIPTION
    content = read_yaml(where)
    _require(content, "smartview_dataset", where)
    if content["smartview_dataset"] != FORMAT_VERSION:
        raise ValueError(
            f"{where}: smartview_dataset: expected {FORMAT_VERSION}, "
            f"found {content['smartview_dataset']!r}"
        )
    for key in ("camera", "target", "joints" if "joints" in content else "poses"):
        _require(content, key, where)
    image_size = _image_size(content["camera"], where)
    mount = content.get("mount", "eye_in_hand")
    try:
        mount_frames(mount)
        target = target_from_dict(content["target"])
        rough = read_rough_pose(content, mount)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    commands = read_commands(folder, content, where, bad_views)
    if "pictures" in content:
        table = folder / content["poses" if "poses" in content else "joints"]["file"]
        files = _picture_files(folder, content["pictures"], commands.views, target, table, where)
        data = from_pictures(
            files,
            commands.poses,
            target,
            mount,
            image_size,
            bad_views,
            commands.masked,
            progress,
            folder / DETECTIONS if keep_detections else None,
            rough if holder_from_world is None else holder_from_world,
        )
        return commands.with_joints(data)
    if not (folder / DETECTIONS).is_file():
        raise ValueError(f"{where}: entry 'pictures' is missing, and there is no {DETECTIONS}")
    data = Dataset.from_arrays(
        target.points,
        read_detections(folder / DETECTIONS, commands.views, len(target.points)),
        commands.poses,
        image_size,
        view_ids=commands.views,
        mount=mount,
        bad_views=bad_views,
        masked_views=list(commands.masked.items()),
        target=target,
    )
    return commands.with_joints(data)


def save_dataset(data: Dataset, folder: str | Path) -> None:
    """Write poses, target and detections as a folder that `load_dataset` reads.

    Raises:
        ValueError: the data set has no target description, or its points are not the target's.
    """
    folder, target = Path(folder), data.target
    if target is None or not np.allclose(data.points, target.points[None], atol=1e-9):
        raise ValueError("save_dataset: the data set needs a target that describes its points")
    write_detections(folder / DETECTIONS, data.view_ids, np.asarray(data.pixels))
    joints = {}
    if data.arm is not None and data.joints is not None:
        entry = write_joints(folder, data.view_ids, np.asarray(data.joints), data.arm)
        joints = {"joints": entry}
    write_folder(
        folder, data.view_ids, data.base_from_tool, data.image_size, target, data.mount, joints
    )


def write_folder(
    folder: Path,
    view_ids: Sequence[str],
    base_from_tool: SE3,
    image_size: tuple[int, int],
    target: AbstractTarget,
    mount: str,
    more: dict[str, Any] | None = None,
) -> None:
    """Write `poses.csv` and `dataset.yaml`; the description last, so that no half is read.

    Args:
        folder: where pictures or detections already are.
        view_ids: one a pose.
        base_from_tool: `(views)`.
        image_size: width and height, px.
        target: what was seen.
        mount: where the camera is.
        more: further entries of the description: of pictures, of joints.
    """
    codec = pose_codec("matrix")
    rows = codec.encode(base_from_tool)
    write_table(
        folder / "poses.csv",
        ("view", *codec.columns),
        [(view, *map(float, row)) for view, row in zip(view_ids, rows, strict=True)],
    )
    description = {
        "smartview_dataset": FORMAT_VERSION,
        "camera": {"image_size": list(image_size)},
        "target": target_to_dict(target),
        "mount": mount,
        "poses": {
            "file": "poses.csv",
            "codec": "matrix",
            "length_unit": "m",
            "angle_unit": "rad",
            "direction": "base_from_tool",
        },
        **(more or {}),
    }
    write_atomically(folder / DESCRIPTION, dump_yaml(description))


def _require(content: dict[str, Any], key: str, where: Path) -> None:
    if key not in content:
        raise ValueError(f"{where}: entry {key!r} is missing")


def _image_size(camera: dict[str, Any], where: Path) -> tuple[int, int]:
    size = camera.get("image_size") if isinstance(camera, dict) else None
    if not (isinstance(size, list) and len(size) == 2 and all(isinstance(n, int) for n in size)):
        raise ValueError(f"{where}: camera.image_size: expected [width, height], found {size!r}")
    return size[0], size[1]


def _picture_files(
    folder: Path,
    content: dict[str, Any],
    views: Sequence[str],
    target: AbstractTarget,
    poses: Path,
    where: Path,
) -> dict[str, list[Path]]:
    """The pictures of each view: one, or one a height."""
    pattern = content.get("pattern")
    if not isinstance(pattern, str) or "{view}" not in pattern:
        raise ValueError(f"{where}: pictures.pattern: expected a name with {{view}} in it")
    heights = len(target.heights) if isinstance(target, StackedTarget) else 1
    if heights > 1 and "{height}" not in pattern:
        raise ValueError(f"{where}: pictures.pattern: {heights} heights need {{height}} in it")
    files = {
        view: [folder / pattern.format(view=view, height=k) for k in range(heights)]
        for view in views
    }
    refuse_strays(files, folder / re.sub(r"{(view|height)}", "*", pattern), poses)
    return files
