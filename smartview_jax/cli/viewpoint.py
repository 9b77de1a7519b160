"""Define `smartview viewpoint`, which prints commands that point the camera at a point."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

import smartview_jax as sv

from . import options
from .options import parse_numbers, with_option_groups
from .robot_commands import CommandSheet, RobotOptions, numbered_names
from .terminal import errors_reported, print_lines

if TYPE_CHECKING:
    from jaxlie import SE3


@dataclass(frozen=True)
class LookOptions:
    """The options that say from where a camera looks at a point."""

    distance: Annotated[
        float | None,
        typer.Option(
            help="Distance from the camera to the point, m, such as 0.35; by default the mean of "
            "the calibration views."
        ),
    ] = None
    tilt: Annotated[
        float, typer.Option(help="Tilt of the camera from vertical, degrees, such as 15.")
    ] = 0.0
    azimuth: Annotated[
        float, typer.Option(help="Where the camera stands, about z from x, degrees, such as 90.")
    ] = 0.0
    roll: Annotated[
        float, typer.Option(help="Roll about the optical axis, degrees, such as -30.")
    ] = 0.0
    five: Annotated[
        bool, typer.Option("--five", help="The paper's five viewpoints; --tilt is their step.")
    ] = False
    below: options.BelowOption = None


@with_option_groups
def viewpoint(
    calibration: Annotated[Path, typer.Argument(help="A calibration.yaml.")],
    at: Annotated[
        str,
        typer.Option(help="Point to look at, x,y,z in m in the world's frame, such as 0.1,0,0.02."),
    ] = "0,0,0",
    *,
    look: LookOptions,
    robot: RobotOptions,
    json: options.JsonOption = False,
    debug: options.DebugOption = False,
) -> None:
    """Print commands that point the camera at a point, and write them for the robot.

    Commands out of reach, behind the target, or far outside the calibrated views are refused, and
    no file is written; --allow overrides a check.
    """
    with errors_reported(debug):
        robot.refuse_unusable()
        loaded_calibration, estimate = sv.joint.load_with_uncertainty(calibration)
        point = np.array(parse_numbers("--at", at, 3, "x,y,z (m)"))
        camera_from_world = requested_camera_poses(loaded_calibration, point, look)
        arm, readings = robot.arm_and_readings(loaded_calibration)
        commands = sv.viewpoint_commands(
            loaded_calibration,
            camera_from_world,
            point[None],
            arm,
            readings,
        )
        names = numbered_names(len(commands.xyzoat))
        sheet = CommandSheet(
            robot, loaded_calibration, names, commands, arm, sv.viewpoints.SAFETY_CHECKS
        )
        covariance = (
            None
            if estimate is None
            else sv.grasping.camera_covariance(loaded_calibration, estimate, commands.command)
        )
        sheet.give(
            "viewpoint",
            json,
            lambda: print_lines(_error_text(names, covariance, calibration)),
            errors=_error_document(names, covariance),
        )


def _error_document(
    names: tuple[str, ...], covariance: np.ndarray | None
) -> list[dict[str, Any]] | None:
    """Return the standard deviations of the camera's error at each view, m and rad."""
    if covariance is None:
        return None
    std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return [
        {"name": name, "axes": "of the camera, x y z", "std_m": row[:3], "std_rad": row[3:]}
        for name, row in zip(names, std, strict=True)
    ]


def _error_text(names: tuple[str, ...], covariance: np.ndarray | None, path: Path) -> str:
    """Return the camera's position error in words: 95 % intervals in mm."""
    errors = _error_document(names, covariance)
    if errors is None:
        return f"{path} has no covariance: the camera's error is not known"
    lines = []
    for entry in errors:
        # 1.96 standard deviations are 95 % of a Gaussian.
        millimetres = sv.geometry.vector_text(1.96e3 * entry["std_m"], 2)
        lines.append(f"{entry['name']}: error of the camera within +- {millimetres} mm (95 %)")
    return "\n".join([*lines, "along its own x, y, z, from the calibration and the robot's noise"])


DEFAULT_DISTANCE = 0.2
"""Default distance from the camera to the point, m, as in the paper.

It is used if the calibration has no region of viewpoints.
"""


def requested_camera_poses(
    calibration: "sv.Calibration", point: np.ndarray, look: LookOptions
) -> "SE3":
    """Return the requested camera poses; the calibration gives the default distance and side."""
    region, distance, below = calibration.region, look.distance, look.below
    if distance is None:
        distance = (
            DEFAULT_DISTANCE
            if region is None
            else float(np.mean(np.asarray(region.distance_range)))
        )
    if not distance > 0.0:
        raise ValueError(f"--distance is in metres and positive; found {distance}")
    above = (None if region is None else region.above) if below is None else not below
    if above is None:
        raise ValueError(
            "the calibration does not state from which side the target was seen: give --above if "
            "the world's z points to the camera, --below if it points away (as a chessboard's does)"
        )
    tilt, azimuth, roll = np.deg2rad((look.tilt, look.azimuth, look.roll))
    if look.five:
        return sv.geometry.five_viewpoints(
            point, distance, float(roll), float(tilt) or sv.geometry.FIVE_VIEWPOINT_STEP, above
        )
    directions = sv.geometry.viewing_direction(tilt, np.array([azimuth]), above)
    return sv.geometry.look_at(point, directions, distance, float(roll))
