"""Collect what is known before views are planned: a calibration, or rough transforms."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from .fit_options import parse_transforms
from .robot_commands import RobotOptions

if TYPE_CHECKING:
    from ..viewpoints import Situation, ViewLimits


def next_views(
    paths: list[Path],
    camera: Path | None,
    limits: "ViewLimits",
    robot: RobotOptions,
    progress: Callable[[str], None],
) -> "tuple[Situation, tuple[str, ...]]":
    """Return the situation given a calibration and its data set, and the names of its views.

    Args:
        paths: the calibration, and the folder of its data set.
        camera: a known camera, which is refused.
        limits: limits of the views.
        robot: the robot's arm and readings.
        progress: called with a line of text for each stage.
    """
    import numpy as np

    from ..io import load_dataset
    from ..joint import load_estimate
    from ..viewpoints import situation_of_estimate

    if camera is not None:
        raise ValueError("--camera: only with --start; the calibration contains its camera")
    if len(paths) != 2 or not paths[1].is_dir():
        raise ValueError(
            "expected calibration.yaml and its data-set folder; or, with --start, the folder alone"
        )
    estimate = load_estimate(paths[0])
    data = load_dataset(paths[1], "mask", progress=progress, keep_detections=False)
    # Without an arm there are no readings, and the robot is commanded by poses.
    _, readings = robot.arm_and_readings(estimate.calibration)
    progress("computing what the views so far tell")
    try:
        found = situation_of_estimate(estimate, np.asarray(data.points[0]), limits, readings)
    except ValueError as error:
        raise ValueError(f"{paths[0]}: {error}") from error
    return found, data.view_ids


def first_views(
    paths: list[Path], start: list[str], camera_file: Path | None, limits: "ViewLimits"
) -> "Situation":
    """Return the situation given rough transforms and the description of a folder."""
    import numpy as np

    from ..calibration import transform_names
    from ..io import read_camera, read_folder_description
    from ..viewpoints import situation_of_drawing

    if len(paths) != 1:
        raise ValueError("--start: expected the data-set folder alone (smartview new begins one)")
    described = read_folder_description(paths[0])
    transforms = parse_transforms(start, described.mount)
    # dataset.yaml may state the target's pose; the option takes precedence.
    if described.holder_from_world is not None:
        transforms.setdefault(transform_names(described.mount)[1], described.holder_from_world)
    return situation_of_drawing(
        transforms,
        described.mount,
        np.asarray(described.target.points),
        described.image_size,
        None if camera_file is None else read_camera(camera_file),
        limits,
    )
