"""The data-set folder: `dataset.yaml`, `poses.csv`, `images/` and cached detections.

    smartview_dataset: 1
    camera: {image_size: [640, 480]}
    target: {kind: circle_grid, rows: 10, columns: 10, spacing: 0.0254}
    mount: eye_in_hand
    poses: {file: poses.csv, codec: quaternion_xyzw, length_unit: m, angle_unit: rad,
            direction: base_from_tool}
    pictures: {pattern: "images/{view}.png"}

`poses.csv` has a column `view` and the codec's columns; `{view}` in the pattern is that name, and
`{height}` the number of the height for a board at several heights. Pictures and poses are paired by
view, never by position.
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
from ..geometry import PoseCodec, pose_codec
from ..targets import AbstractTarget, StackedTarget, target_from_dict, target_to_dict
from .detections import DETECTIONS, read_detections, write_detections
from .pictures import from_pictures, refuse_strays
from .tables import duplicates, numbers, read_table, write_table

FORMAT_VERSION = 1
DESCRIPTION = "dataset.yaml"

_DIRECTIONS = ("base_from_tool", "tool_from_base")


def load_folder(
    folder: Path,
    bad_views: str = "raise",
    progress: Callable[[str], None] | None = None,
    keep_detections: bool = True,
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
    for key in ("camera", "target", "poses"):
        _require(content, key, where)
    image_size = _image_size(content["camera"], where)
    mount = content.get("mount", "eye_in_hand")
    try:
        mount_frames(mount)
        target = target_from_dict(content["target"])
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    views, poses, masked = _read_poses(folder, content["poses"], where, bad_views)
    if "pictures" in content:
        return from_pictures(
            _picture_files(
                folder, content["pictures"], views, target, folder / content["poses"]["file"], where
            ),
            poses,
            target,
            mount,
            image_size,
            bad_views,
            masked,
            progress,
            folder / DETECTIONS if keep_detections else None,
        )
    if not (folder / DETECTIONS).is_file():
        raise ValueError(f"{where}: entry 'pictures' is missing, and there is no {DETECTIONS}")
    return Dataset.from_arrays(
        target.points,
        read_detections(folder / DETECTIONS, views, len(target.points)),
        poses,
        image_size,
        view_ids=views,
        mount=mount,
        bad_views=bad_views,
        masked_views=list(masked.items()),
        target=target,
    )


def save_dataset(data: Dataset, folder: str | Path) -> None:
    """Write poses, target and detections as a folder that `load_dataset` reads.

    Raises:
        ValueError: the data set has no target description, or its points are not the target's.
    """
    folder, target = Path(folder), data.target
    if target is None or not np.allclose(data.points, target.points[None], atol=1e-9):
        raise ValueError("save_dataset: the data set needs a target that describes its points")
    write_detections(folder / DETECTIONS, data.view_ids, np.asarray(data.pixels))
    write_folder(folder, data.view_ids, data.base_from_tool, data.image_size, target, data.mount)


def write_folder(
    folder: Path,
    view_ids: Sequence[str],
    base_from_tool: SE3,
    image_size: tuple[int, int],
    target: AbstractTarget,
    mount: str,
    pictures: str | None = None,
) -> None:
    """Write `poses.csv` and `dataset.yaml`; the description last, so that no half is read.

    Args:
        folder: where pictures or detections already are.
        view_ids: one a pose.
        base_from_tool: `(views)`.
        image_size: width and height, px.
        target: what was seen.
        mount: where the camera is.
        pictures: pattern of their names; None where there are detections alone.
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
        **({} if pictures is None else {"pictures": {"pattern": pictures}}),
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


def _read_poses(
    folder: Path, content: dict[str, Any], where: Path, bad_views: str
) -> tuple[list[str], SE3, dict[str, str]]:
    """View ids, poses, and the views whose pose is masked, with reasons."""
    for key in ("file", "codec", "length_unit", "angle_unit", "direction"):
        if key not in content:
            raise ValueError(f"{where}: entry 'poses.{key}' is missing: units are never guessed")
    if content["direction"] not in _DIRECTIONS:
        raise ValueError(
            f"{where}: poses.direction is one of {', '.join(_DIRECTIONS)}; "
            f"found {content['direction']!r}"
        )
    path = folder / content["file"]
    try:
        codec = pose_codec(content["codec"])
    except ValueError as error:
        raise ValueError(f"{where}: poses.codec: {error}") from error
    table = read_table(path, ("view", *codec.columns))
    views = [row["view"] for row in table]
    if duplicates(views):
        raise ValueError(f"{path}: view {', '.join(duplicates(views))} has more than one row")
    if not views:
        raise ValueError(f"{path}: no poses")
    rows = np.stack([numbers(path, row, codec.columns, row["view"]) for row in table])
    units = (content["length_unit"], content["angle_unit"])
    masked = _undecodable(codec, rows, units, views) if bad_views == "mask" else {}
    good = [view not in masked for view in views]
    # The pose of a masked view is never used; any other stands in for it.
    rows = np.where(np.array(good)[:, None], rows, rows[good.index(True) if any(good) else 0])
    try:
        poses = codec.decode(rows, *units, labels=views)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return views, poses if content["direction"] == "base_from_tool" else poses.inverse(), masked


def _undecodable(
    codec: PoseCodec, rows: np.ndarray, units: tuple[str, str], views: list[str]
) -> dict[str, str]:
    problems = {}
    for view, row in zip(views, rows, strict=True):
        try:
            codec.decode(row[None], *units, labels=[view])
        except ValueError as error:
            problems[view] = str(error)
    return problems


def _picture_files(
    folder: Path,
    content: dict[str, Any],
    views: list[str],
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
