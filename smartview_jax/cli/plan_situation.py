"""Collect what is known before views are planned: a calibration, or rough transforms."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from .fit_options import parse_transforms
from .robot_commands import RobotOptions

if TYPE_CHECKING:
    import numpy as np

    from ..calibration import Calibration
    from ..viewpoints import InformationModel, ViewRange

ASSUMED_FOCAL_LENGTH = 1.2
"""Focal length of an unknown camera, relative to the picture's longer side."""

FIRST_BORDER = 0.1
"""Margin of first views, relative to the shorter side, for errors of the rough transforms."""


class ViewLimits(NamedTuple):
    """The limits of views that the user set.

    Attributes:
        distance: smallest and largest distance from the target, m; None to choose them.
        tilt: largest tilt, rad.
        roll: largest roll, rad.
        below: whether to look from where the world's z is negative; None to infer the side.
    """

    distance: tuple[float, float] | None
    tilt: float
    roll: float
    below: bool | None


class Situation(NamedTuple):
    """The state of knowledge before the views of a plan are taken.

    Attributes:
        calibration: the calibration, or a rough one.
        model: information about its parameters, and the information that a view adds.
        points: the target's points, m.
        views: range of the views.
        border_margin: width of the picture's border that has to stay free, px.
        names: names of the views that exist already.
        assumptions: what was assumed, in sentences.
    """

    calibration: "Calibration"
    model: "InformationModel"
    points: "np.ndarray"
    views: "ViewRange"
    border_margin: float
    names: tuple[str, ...]
    assumptions: tuple[str, ...]


def next_views(
    paths: list[Path],
    camera: Path | None,
    limits: ViewLimits,
    robot: RobotOptions,
    progress: Callable[[str], None],
) -> Situation:
    """Return the situation given a calibration and its data set.

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
    from ..viewpoints import model_from_estimate

    if camera is not None:
        raise ValueError("--camera: only with --start; the calibration contains its camera")
    if len(paths) != 2 or not paths[1].is_dir():
        raise ValueError(
            "expected calibration.yaml and its data-set folder; or, with --start, the folder alone"
        )
    estimate = load_estimate(paths[0])
    data = load_dataset(paths[1], "mask", progress=progress, keep_detections=False)
    points = np.asarray(data.points[0])
    _, readings = robot.arm_and_readings(estimate.calibration)
    # Without an arm there are no readings, and the robot is commanded by poses.
    progress("computing what the views so far tell")
    model = model_from_estimate(estimate, points, readings)
    # New views stay near the calibrated ones.
    region = estimate.calibration.region
    if region is None:
        raise ValueError(f"{paths[0]}: region: missing; calibrate again to add it")
    distances = tuple(float(x) for x in np.asarray(region.distance_range))
    below = limits.below
    above = bool(float(region.side) >= 0.0) if below is None else not below
    # A tenth on either side: views at one distance only would leave no range.
    widened = (0.9 * distances[0], 1.1 * distances[1])
    views = _view_range(points, limits, widened, above)
    return Situation(estimate.calibration, model, points, views, 0.0, data.view_ids, ())


def first_views(
    paths: list[Path], start: list[str], camera_file: Path | None, limits: ViewLimits
) -> Situation:
    """Return the situation given rough transforms and the description of a folder."""
    import numpy as np

    from ..calibration import Calibration
    from ..cameras import Camera, Pinhole
    from ..io import read_camera, read_folder_description
    from ..staged import require_picture_size
    from ..viewpoints import (
        TYPICAL_NOISE,
        InformationModel,
        first_view_distances,
        with_assumed_region,
    )

    if len(paths) != 1:
        raise ValueError("--start: expected the data-set folder alone (smartview new begins one)")
    described = read_folder_description(paths[0])
    transforms = parse_transforms(start, described.mount)
    points, assumptions = np.asarray(described.target.points), []
    # The field of view of many cameras is about 45 degrees; the border margin covers the others.
    if camera_file is None:
        width, height = described.image_size
        focal = ASSUMED_FOCAL_LENGTH * max(width, height)
        camera = Camera(
            focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), Pinhole(), (width, height)
        )
        assumptions.append(f"camera not known: a focal length of {focal:.0f} px is assumed")
    else:
        camera = read_camera(camera_file)
        require_picture_size("--camera", camera, described.image_size)
    # Nothing is fitted here: errors of centimetres show in the first picture.
    mount, holder = _both_transforms(transforms, described)
    rough = Calibration(camera, mount, holder, described.mount)
    above = _side(rough, limits.below)
    distances = limits.distance or first_view_distances(rough, points)
    # The checks of commands need to know on which side of the target the robot may be.
    rough = with_assumed_region(rough, points, distances, above)
    # No prior: the views are to determine the parameters that are rough.
    model = InformationModel.from_calibration(
        rough, points, TYPICAL_NOISE, fixed=() if camera_file is None else ("camera",)
    )
    noise = TYPICAL_NOISE
    assumptions.append(
        f"assumed errors: {noise.pixel:g} px, {1e3 * noise.translation:g} mm and "
        f"{np.rad2deg(noise.rotation):g} degrees of the robot; the transforms are rough: go slowly"
    )
    views = _view_range(points, limits, distances, above)
    margin = FIRST_BORDER * min(described.image_size)
    return Situation(rough, model, points, views, margin, (), tuple(assumptions))


def _both_transforms(transforms: dict[str, Any], described: Any) -> tuple[Any, Any]:
    """Return camera_from_mount and holder_from_world, the latter also from the description."""
    from ..calibration import transform_names

    mount_name, holder_name = transform_names(described.mount)
    # dataset.yaml may state the target's pose; the option takes precedence.
    holder = transforms.get(holder_name, described.holder_from_world)
    missing = [
        name
        for name, transform in ((mount_name, transforms.get(mount_name)), (holder_name, holder))
        if transform is None
    ]
    if missing:
        raise ValueError(f"--start {missing[0]}=x,y,z,yaw,pitch,roll (m, degrees): missing")
    return transforms[mount_name], holder


def _side(rough: "Calibration", below: bool | None) -> bool:
    """Return whether the first views look from where the world's z is positive."""
    if below is not None:
        return not below
    from ..geometry import host_matrices

    up = float(host_matrices(rough.holder_from_world)[2, 2])
    # A target that lies flat is seen from above; one that hangs may face anywhere.
    if rough.mount != "eye_in_hand" or abs(up) < 0.5:
        raise ValueError(
            "from which side is the target seen? Give --above if its z axis points to the camera, "
            "--below if it points away (as a chessboard's does)"
        )
    return up > 0.0


def _view_range(
    points: "np.ndarray", limits: ViewLimits, distances: tuple[float, float], above: bool
) -> "ViewRange":
    """Return the range of views about the middle of the target."""
    from ..viewpoints import ViewRange

    # The option takes precedence over distances of the calibration or from the target's size.
    span = limits.distance or distances
    return ViewRange(points.mean(axis=0), span, limits.tilt, limits.roll, above=above)
