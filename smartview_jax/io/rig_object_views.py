"""Read a folder of pictures of an object by several cameras.

    smartview_object_views: 1
    cameras:
      left: {image_size: [1280, 1024]}
      right: {image_size: [1280, 1024]}
    poses: {file: poses.csv, codec: matrix, length_unit: m, angle_unit: rad,
            direction: base_from_tool}
    pictures: {pattern: "images/{camera}/{view}.png"}
    end: smartview_object_views

The file is called `object_views.yaml`, as in a folder of one camera (`object_views`). The table of
poses has a row for each state of the robot; a camera has a picture of a state or has none. Cameras
next to the arm need no robot: `views: [a, b]` in the place of `poses` names the states.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8

from ..detection import read_picture
from ..files import read_yaml
from ..modeling import command_at
from ..robots import Command
from .object_views import OBJECT_VIEWS_FILE
from .robot_readings import read_robot_readings


class RigObjectViews(NamedTuple):
    """Pictures of an object by several cameras, with the robot's reported poses.

    Attributes:
        view_ids: names of the views, the camera's name before the state's: `left/3`.
        cameras: name of the camera of each view.
        states: name of the robot's state in each view.
        paths: files of the pictures.
        pictures: grey levels.
        command: reported pose of each view, with joint readings if the folder has them; None
            without a robot.
        notes: sentences on what was recognised in the tables.
    """

    view_ids: tuple[str, ...]
    cameras: tuple[str, ...]
    states: tuple[str, ...]
    paths: tuple[Path, ...]
    pictures: tuple[UInt8[np.ndarray, "rows columns"], ...]
    command: Command | None
    notes: tuple[str, ...] = ()


def is_rig_object_views(folder: str | Path) -> bool:
    """Return whether a folder's `object_views.yaml` has several cameras; false without the file."""
    path = Path(folder) / OBJECT_VIEWS_FILE
    return path.is_file() and "cameras" in read_yaml(path)


def load_rig_object_views(folder: str | Path) -> RigObjectViews:
    """Read the pictures of an object by several cameras, and the robot's poses.

    Raises:
        FileNotFoundError: the description or a table is missing, or a state has no picture.
        ValueError: a wrong entry, view or picture; the message names it and the file.
    """
    from ..schemas.object_views import RIG_OBJECT_VIEWS_SCHEMA
    from ..schemas.validation import validate_content

    folder = Path(folder)
    path = folder / OBJECT_VIEWS_FILE
    content = read_yaml(path)
    description = validate_content(content, RIG_OBJECT_VIEWS_SCHEMA, path)
    pattern = description.pictures.pattern
    states, command, notes = description.views, None, ()
    if states is None:
        states, command, notes = _robot(folder, content, pattern, path)
    found = [
        (camera, k, folder / pattern.format(camera=camera, view=state))
        for k, state in enumerate(states)
        for camera in description.cameras
    ]
    found = [entry for entry in found if entry[2].is_file()]
    seen = {k for _, k, _ in found}
    for k, state in enumerate(states):
        if k not in seen:
            raise FileNotFoundError(f"{folder / pattern}: no camera has a picture of view {state}")
    sizes = {name: entry.image_size for name, entry in description.cameras.items()}
    rows = np.array([k for _, k, _ in found])
    return RigObjectViews(
        tuple(f"{camera}/{states[k]}" for camera, k, _ in found),
        tuple(camera for camera, _, _ in found),
        tuple(states[k] for k in rows),
        tuple(file for _, _, file in found),
        tuple(read_picture(file, (sizes[c][0], sizes[c][1])) for c, _, file in found),
        None if command is None else command_at(command, rows),
        notes,
    )


def _robot(
    folder: Path, content: dict[str, Any], pattern: str, path: Path
) -> tuple[list[str], Command, tuple[str, ...]]:
    """Return the names of the robot's states, its reported poses, and notes on the tables."""
    # A view's name in the table may end as the picture's does, which the first camera's tell.
    first = {"pictures": {"pattern": pattern.replace("{camera}", next(iter(content["cameras"])))}}
    readings = read_robot_readings(folder, {**content, **first}, path, "raise")
    readings.refuse_masked(path)
    return list(readings.view_ids), readings.command, readings.notes
