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

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxlie import SE3

from ..calibration import mount_frames
from ..dataset import Dataset
from ..detection import Detection, consistent_ordering, detect, read_picture
from ..files import dump_yaml, read_yaml, write_atomically
from ..geometry import pose_codec
from ..targets import AbstractTarget, StackedTarget, target_from_dict, target_to_dict
from .tables import duplicates, numbers, read_table, write_table

FORMAT_VERSION = 1
DESCRIPTION = "dataset.yaml"
DETECTIONS = "detections.csv"

_DIRECTIONS = ("base_from_tool", "tool_from_base")


def load_folder(
    folder: Path,
    bad_views: str = "raise",
    progress: Callable[[str], None] | None = None,
    keep_detections: bool = True,
) -> Dataset:
    """A data set from a folder with a `dataset.yaml`; see `load_dataset`."""
    content = read_yaml(folder / DESCRIPTION)
    where = folder / DESCRIPTION
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
    views, poses = _read_poses(folder, content["poses"], where)

    masked: dict[str, str] = {}
    if "pictures" in content:
        files = _picture_files(folder, content["pictures"], views, target, where)
        detections, masked = _detections(
            folder, files, target, image_size, bad_views, progress, keep_detections
        )
        pixels = np.stack([detections[view].pixels for view in views])
        pixels = _ordered(pixels, target, poses, mount, image_size)
        pictures = [files[view][0] for view in views]
    else:
        pixels, pictures = _imported_detections(folder, views, len(target.points)), None
    return Dataset.from_arrays(
        target.points,
        pixels,
        poses,
        image_size,
        view_ids=views,
        mount=mount,
        bad_views=bad_views,
        masked_views=list(masked.items()),
        pictures=pictures,
        target=target,
    )


def save_dataset(data: Dataset, folder: str | Path) -> None:
    """Write poses, target and detections as a folder that `load_dataset` reads.

    Raises:
        ValueError: the data set has no target description, or its points are not the target's.
    """
    folder = Path(folder)
    target = data.target
    if target is None or not np.allclose(data.points, target.points[None], atol=1e-9):
        raise ValueError("save_dataset: the data set needs a target that describes its points")
    codec = pose_codec("matrix")
    rows = codec.encode(data.base_from_tool)
    write_table(
        folder / "poses.csv",
        ("view", *codec.columns),
        [(view, *map(float, row)) for view, row in zip(data.view_ids, rows, strict=True)],
    )
    _write_detections(
        folder / DETECTIONS, dict(zip(data.view_ids, np.asarray(data.pixels), strict=True))
    )
    description = {
        "smartview_dataset": FORMAT_VERSION,
        "camera": {"image_size": list(data.image_size)},
        "target": target_to_dict(target),
        "mount": data.mount,
        "poses": {
            "file": "poses.csv",
            "codec": "matrix",
            "length_unit": "m",
            "angle_unit": "rad",
            "direction": "base_from_tool",
        },
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


def _read_poses(folder: Path, content: dict[str, Any], where: Path) -> tuple[list[str], SE3]:
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
    try:
        poses = codec.decode(rows, content["length_unit"], content["angle_unit"], views)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return views, poses if content["direction"] == "base_from_tool" else poses.inverse()


def _picture_files(
    folder: Path,
    content: dict[str, Any],
    views: list[str],
    target: AbstractTarget,
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
    known = {path for paths in files.values() for path in paths}
    parent = (folder / pattern).parent
    suffix = Path(pattern).suffix
    if parent.is_dir():
        strays = sorted(path.name for path in parent.glob(f"*{suffix}") if path not in known)
        if strays:
            raise ValueError(
                f"{folder / content.get('file', 'poses.csv')}: no pose for the picture "
                f"{', '.join(strays[:5])} of {parent}: a row is missing, or a picture too many"
            )
    return files


def _detections(
    folder: Path,
    files: dict[str, list[Path]],
    target: AbstractTarget,
    image_size: tuple[int, int],
    bad_views: str,
    progress: Callable[[str], None] | None,
    keep: bool,
) -> tuple[dict[str, Detection], dict[str, str]]:
    """A detection a view, from the cache where it is fresh, and the views to mask with reasons."""
    cache = folder / DETECTIONS
    say = progress or (lambda _: None)
    masked: dict[str, str] = {}
    stamp = _fingerprint(files, target)
    cached = _cached(cache, stamp, list(files), len(target.points))
    if cached is not None:
        say(f"detections of {len(files)} views from {cache.name}")
        detections = cached
    else:
        detections = {}
        for number, (view, paths) in enumerate(files.items(), start=1):
            say(f"looking for the target: view {view} ({number} of {len(files)})")
            try:
                detections[view] = _detect_view(paths, target, image_size)
            except (FileNotFoundError, ValueError) as error:
                if bad_views != "mask":
                    raise
                detections[view] = _empty(target, str(error))
        if keep:
            _keep(cache, detections, stamp, say)
    for view, detection in detections.items():
        if not detection.visible.any():
            masked[view] = detection.reason or "no point of the target was seen"
    if len(masked) == len(files):
        first = next(iter(masked.values()))
        raise ValueError(
            f"{folder}: the target was found in none of {len(files)} pictures ({first}): "
            f"does the description in {DESCRIPTION} fit the pictures?"
        )
    return detections, masked


def _keep(
    cache: Path, detections: dict[str, Detection], stamp: str, say: Callable[[str], None]
) -> None:
    try:
        _write_detections(cache, {view: d.pixels for view, d in detections.items()}, stamp)
    except OSError as error:
        say(f"detections are not kept: {error}")


def _empty(target: AbstractTarget, reason: str) -> Detection:
    count = len(target.points)
    return Detection(np.full((count, 2), np.nan), np.zeros(count, dtype=bool), reason)


def _detect_view(
    paths: list[Path], target: AbstractTarget, image_size: tuple[int, int]
) -> Detection:
    board = target.board if isinstance(target, StackedTarget) else target
    parts = [detect(read_picture(path, image_size), board) for path in paths]
    reasons = [part.reason for part in parts if part.reason]
    return Detection(
        np.concatenate([part.pixels for part in parts]),
        np.concatenate([part.visible for part in parts]),
        "; ".join(reasons) or None,
    )


def _ordered(
    pixels: np.ndarray,
    target: AbstractTarget,
    poses: SE3,
    mount: str,
    image_size: tuple[int, int],
) -> np.ndarray:
    symmetries = target.symmetries
    if len(symmetries) == 1:
        return pixels
    mount_from_holder = poses.inverse() if mount == "eye_in_hand" else poses
    chosen = consistent_ordering(
        pixels,
        np.asarray(np.isfinite(pixels).all(axis=-1)),
        target.points,
        symmetries,
        np.asarray(mount_from_holder.rotation().as_matrix()),
        image_size,
    )
    return np.stack([where[symmetries[k]] for where, k in zip(pixels, chosen, strict=True)])


def _fingerprint(files: dict[str, list[Path]], target: AbstractTarget) -> str:
    """Changes with the target's description and with any picture."""
    digest = hashlib.sha256(repr(target).encode())
    for view, paths in files.items():
        digest.update(view.encode())
        for path in paths:
            digest.update(path.read_bytes() if path.is_file() else b"missing")
    return digest.hexdigest()[:16]


def _write_detections(path: Path, pixels: dict[str, np.ndarray], stamp: str = "") -> None:
    rows = [
        (view, int(point), float(where[point, 0]), float(where[point, 1]), stamp)
        for view, where in pixels.items()
        for point in np.flatnonzero(np.isfinite(where).all(axis=1))
    ]
    write_table(path, ("view", "point", "u_px", "v_px", "pictures"), rows)


def _cached(path: Path, stamp: str, views: list[str], count: int) -> dict[str, Detection] | None:
    if not path.is_file():
        return None
    table = read_table(path, ("view", "point", "u_px", "v_px", "pictures"))
    if not table or any(row["pictures"] != stamp for row in table):
        return None
    pixels = _pixels(path, table, views, count)
    return {
        view: Detection(where, np.asarray(np.isfinite(where).all(axis=1)), None)
        for view, where in zip(views, pixels, strict=True)
    }


def _imported_detections(folder: Path, views: list[str], count: int) -> np.ndarray:
    """Detections that came with the folder, which then needs no pictures."""
    path = folder / DETECTIONS
    if not path.is_file():
        raise ValueError(
            f"{folder / DESCRIPTION}: entry 'pictures' is missing, and there is no {DETECTIONS}"
        )
    table = read_table(path, ("view", "point", "u_px", "v_px"))
    return _pixels(path, table, views, count)


def _pixels(path: Path, table: list[dict[str, str]], views: list[str], count: int) -> np.ndarray:
    index = {view: k for k, view in enumerate(views)}
    pixels = np.full((len(views), count, 2), np.nan)
    for row in table:
        view = row["view"]
        if view not in index:
            raise ValueError(f"{path}: view {view} has no pose")
        point, u, v = numbers(path, row, ("point", "u_px", "v_px"), view)
        if point != int(point) or not 0 <= point < count:
            raise ValueError(f"{path}: view {view}: the target has no point {point:g}")
        pixels[index[view], int(point)] = u, v
    return pixels
