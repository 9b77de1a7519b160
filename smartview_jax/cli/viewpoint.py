"""Define `smartview viewpoint`, which prints commands by which the camera looks at a point."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..files import refuse_unwritable
from .options import DebugOption
from .terminal import errors_reported

if TYPE_CHECKING:
    import numpy as np
    from jaxlie import SE3

    from ..calibration import Calibration
    from ..robots import SerialArm


def viewpoint(
    calibration: Annotated[Path, typer.Argument(help="A calibration.yaml.")],
    at: Annotated[
        tuple[float, float, float], typer.Option(help="Point to look at, in the world's frame, m.")
    ] = (0.0, 0.0, 0.0),
    distance: Annotated[
        float | None,
        typer.Option(help="From the camera to the point, m; by default that of the calibration."),
    ] = None,
    tilt: Annotated[float, typer.Option(help="From straight above, degrees.")] = 0.0,
    azimuth: Annotated[
        float, typer.Option(help="Where the camera stands, about z from x, degrees.")
    ] = 0.0,
    roll: Annotated[float, typer.Option(help="About the optical axis, degrees.")] = 0.0,
    five: Annotated[
        bool, typer.Option("--five", help="The paper's five viewpoints; tilt is their step.")
    ] = False,
    below: Annotated[
        bool | None,
        typer.Option(
            "--below/--above",
            help="The camera stands where the world's z is negative, or positive; by default on "
            "the side from which the calibration saw the target.",
        ),
    ] = None,
    arm: Annotated[
        str | None,
        typer.Option(help="Joint readings too: an arm's name (puma_560, ...) or a .urdf file."),
    ] = None,
    near: Annotated[
        str | None,
        typer.Option(help="Readings to set out from, degrees (m where a joint slides): 0,-10,40."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Also write the commands: a .val, .csv or .json file.")
    ] = None,
    pose_format: Annotated[
        str,
        typer.Option(
            "--format",
            help="How the robot's maker writes poses: val_oat, kawasaki_oat, kuka_abc, ur, "
            "fanuc_wpr, abb, quaternion_xyzw, ...; .val files have VAL's.",
        ),
    ] = "val_oat",
    force: Annotated[
        bool,
        typer.Option("--force", help="Also what lies outside of what the calibration knows."),
    ] = False,
    debug: DebugOption = False,
) -> None:
    """Print commands by which the camera looks at a point, and write them for the robot.

    Refused, with nothing written, are commands out of reach, on the side of the target that was
    not seen, or far outside the views that the calibration was fitted to.
    """
    with errors_reported(debug):
        import numpy as np

        from ..calibration import Calibration
        from ..geometry import pose_codec
        from ..io import write_viewpoints
        from ..viewpoints import viewpoint_commands
        from .viewpoint_tables import print_joints, print_viewpoints

        if out is not None:
            refuse_unwritable(out.parent, "--out")
        loaded_calibration, codec = Calibration.load(calibration), pose_codec(pose_format)
        point = np.array(at)
        camera_from_world = _requested_camera_poses(
            loaded_calibration, point, distance, (tilt, azimuth, roll), five, below
        )
        serial_arm = _arm_from_option(arm, loaded_calibration)
        commands = viewpoint_commands(
            loaded_calibration,
            camera_from_world,
            point[None],
            serial_arm,
            _parse_joint_readings(near, serial_arm),
        )
        # Printed before any refusal, which refers to the views by the names in the table.
        print_viewpoints(commands, codec)
        joints = None if commands.joints is None else np.asarray(commands.joints)
        if serial_arm is not None and joints is not None:
            print_joints(joints, serial_arm)
        for text in _view_messages(commands.checks.reasons()):
            typer.echo(text)
        violations = _view_messages(commands.checks.safety_violations())
        if violations and not force:
            raise ValueError(
                f"refused, and nothing is written: {'; '.join(violations)}. --force if it is meant"
            )
        if out is not None:
            write_viewpoints(out, commands.base_from_tool, None, joints, pose_format)
            typer.echo(out)


DEFAULT_DISTANCE = 0.2
"""Default distance from the camera to the point, m, as in the paper.

It is used where a calibration has no region of viewpoints.
"""


def _requested_camera_poses(
    calibration: "Calibration",
    point: "np.ndarray",
    distance: float | None,
    angles_deg: tuple[float, float, float],
    five: bool,
    below: bool | None,
) -> "SE3":
    """Return the requested camera poses; distance and side default to those of the calibration."""
    import numpy as np

    from ..viewpoints import FIVE_VIEWPOINT_STEP, five_viewpoints, look_at, viewing_direction

    region = calibration.region
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
            "the calibration does not say from which side the target was seen: --above if the "
            "world's z points to the camera, --below if away from it (as a chessboard's does)"
        )
    tilt, azimuth, roll = np.deg2rad(angles_deg)
    if five:
        return five_viewpoints(
            point, distance, float(roll), float(tilt) or FIVE_VIEWPOINT_STEP, above
        )
    directions = viewing_direction(tilt, np.array([azimuth]), above)
    return look_at(point, directions, distance, float(roll))


def _view_messages(texts: tuple[str, ...]) -> list[str]:
    """Return the texts that are not empty, each with its view's name as in the table."""
    return [f"v{1 + k}: {text}" for k, text in enumerate(texts) if text]


def _arm_from_option(text: str | None, calibration: "Calibration") -> "SerialArm | None":
    """Return the named arm, or else the arm whose errors the calibration corrects, or None."""
    from ..io import load_urdf
    from ..robot_errors import nominal_arm
    from ..robots import arm_by_name

    if text is not None:
        return load_urdf(text) if text.endswith(".urdf") else arm_by_name(text)
    return nominal_arm(calibration.field)


def _parse_joint_readings(text: str | None, arm: "SerialArm | None") -> "np.ndarray | None":
    """Return joint readings (rad, m) from text in degrees and metres; None without an arm."""
    import numpy as np

    if arm is None:
        if text is not None:
            raise ValueError("--near: no arm to read; name one by --arm")
        return None
    if text is None:
        # Inverse kinematics has several solutions; the one nearest to given readings is chosen.
        raise ValueError("an arm reaches a pose in several ways: say --near which readings")
    try:
        readings = np.array([float(word) for word in text.split(",")])
    except ValueError:
        readings = np.array([])
    if len(readings) != arm.joint_count or not np.isfinite(readings).all():
        raise ValueError(
            f"--near: expected {arm.joint_count} numbers between commas, found {text!r}"
        )
    return np.where(arm.prismatic, readings, np.deg2rad(readings))
