"""Define `smartview grasp`, which prints the commands that bring the gripper to an object."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import smartview_jax as sv

from . import options
from .options import with_option_groups
from .robot_commands import CommandSheet, RobotOptions
from .terminal import errors_reported, print_lines

COMMAND_NAMES = ("approach", "grasp")
"""The names of the two commands, in the order in which the robot takes them."""

_POSE = "x,y,z in m and yaw,pitch,roll in degrees"


@dataclass(frozen=True)
class GraspChoice:
    """The options that say where on an object the gripper takes it, and where the gripper is."""

    grasp_pose: Annotated[
        str | None,
        typer.Option(
            help=f"object_from_gripper: pose of the grasp on the object, {_POSE}, such as "
            "0,0,0.01,0,180,0."
        ),
    ] = None
    model: Annotated[
        Path | None,
        typer.Option(
            help="Instead of --grasp-pose: an object model with grasps, such as object.json of "
            "smartview model."
        ),
    ] = None
    name: Annotated[
        str | None,
        typer.Option(help="Name of one of the model's grasps, such as side; by default its first."),
    ] = None
    gripper: Annotated[
        str,
        typer.Option(
            help=f"tool_from_gripper: pose of the gripper's frame on the tool, {_POSE}, such as "
            "0,0,0.12,0,0,0; by default the robot's tool frame, between the fingertips."
        ),
    ] = "0,0,0,0,0,0"

    def object_from_gripper(self) -> np.ndarray:
        """Return the pose of the options, or of the named or first grasp of the model."""
        model, name = self.model, self.name
        if (self.grasp_pose is None) == (model is None):
            raise ValueError("grasp: give either --grasp-pose or --model")
        if model is None:
            if name is not None:
                raise ValueError("--name selects a grasp of a model: give --model too")
            return _pose("--grasp-pose", str(self.grasp_pose))
        grasps = sv.io.load_object_model(model).grasps
        if not grasps:
            raise ValueError(f"{model}: no grasps in it; place one with smartview model")
        chosen = [candidate for candidate in grasps if name in (None, candidate.name)]
        if not chosen:
            names = ", ".join(repr(candidate.name) for candidate in grasps)
            raise ValueError(f"--name: {model} has the grasps {names}; found {name!r}")
        return chosen[0].object_from_tool


@with_option_groups
def grasp(
    calibration: Annotated[Path, typer.Argument(help="A calibration.yaml.")],
    object_pose: Annotated[
        str,
        typer.Option(
            help=f"world_from_object: pose of the object, {_POSE}, such as 0.1,0.02,0,90,0,0."
        ),
    ] = "0,0,0,0,0,0",
    *,
    chosen: GraspChoice,
    approach: Annotated[
        float, typer.Option(min=0.0, help="Length of the straight approach, mm, such as 50.")
    ] = 100.0,
    robot: RobotOptions,
    json: options.JsonOption = False,
    debug: options.DebugOption = False,
) -> None:
    """Print the commands that bring the gripper to a grasp of an object (the paper's Eq. 20).

    The gripper's z axis points from the palm to the object. Commands out of reach or behind the
    target's plane are refused, and no file is written.
    """
    with errors_reported(debug):
        robot.refuse_unusable()
        loaded_calibration, estimate = sv.joint.load_with_uncertainty(calibration)
        world_from_gripper = _pose("--object-pose", object_pose) @ chosen.object_from_gripper()
        arm, readings = robot.arm_and_readings(loaded_calibration)
        tool = sv.tool_commands(
            loaded_calibration,
            # H_Base^World is applied by the calibration; here is the rest of Eq. 20.
            _with_approach(world_from_gripper, 1e-3 * approach, _pose("--gripper", chosen.gripper)),
            estimate=estimate,
            arm=arm,
            near=readings,
        )
        sheet = CommandSheet(
            robot, loaded_calibration, COMMAND_NAMES, tool.commands, arm, sv.grasping.TOOL_CHECKS
        )
        sheet.give(
            "grasp",
            json,
            lambda: print_lines(_error_text(tool, calibration)),
            error=_error_document(tool),
        )


def _pose(option: str, text: str) -> np.ndarray:
    return sv.geometry.host_matrices(sv.io.parse_rough_pose(option, text))


def _with_approach(
    world_from_gripper: np.ndarray, distance: float, tool_from_gripper: np.ndarray
) -> np.ndarray:
    """Return `world_from_tool` before the grasp and at it, `(2, 4, 4)`."""
    back = np.eye(4)
    back[2, 3] = -distance
    gripper_from_tool = np.linalg.inv(tool_from_gripper)
    return np.stack([world_from_gripper @ back, world_from_gripper]) @ gripper_from_tool


def _error_document(tool: "sv.grasping.ToolCommands") -> dict[str, Any] | None:
    """Return the standard deviations of the tool's error at the grasp, m and rad."""
    if tool.covariance is None:
        return None
    # The last pose is the grasp itself.
    std = np.sqrt(np.diagonal(tool.covariance[-1]))
    return {"axes": "of the tool, x y z", "std_m": std[:3], "std_rad": std[3:]}


def _error_text(tool: "sv.grasping.ToolCommands", path: Path) -> str:
    """Return the tool's error in words: 95 % intervals in mm and degrees."""
    errors = _error_document(tool)
    if errors is None:
        return f"{path} has no covariance: the tool's error is not known"
    # 1.96 standard deviations are 95 % of a Gaussian.
    millimetres = sv.geometry.vector_text(1.96e3 * errors["std_m"], 2)
    degrees = sv.geometry.vector_text(1.96 * np.rad2deg(errors["std_rad"]), 3)
    return (
        f"error of the tool: within +- {millimetres} mm and +- {degrees} degrees (95 %) along and "
        "about its own x, y, z, from the calibration's uncertainty and the robot's noise; the "
        "object's pose error is not included"
    )
