"""Calibrate a cell: pictures of a board from planned views, then the staged and the joint fit."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from ..calibration import Calibration
from ..calibration_pipeline import CalibrationFit, calibrate
from ..dataset import Dataset
from ..detection import correct_circle_centres, detect
from ..geometry import host_matrices, look_at, viewing_direction
from ..robots import Command, SerialArm, joints_for_pose
from ..runtime.array_namespace import to_device
from ..simulation import Cell
from ..staged import fit_staged
from ..targets import AbstractTarget, CircleGrid

MIN_VIEWS = 6
"""Smallest number of views in which the board has to be found."""

AIM_SPREAD = 0.25
"""Largest distance of the camera's aim from the board's middle, over the board's size."""


class BoardViews(NamedTuple):
    """The views of a board from which a cell is calibrated, tilted and rolled at random.

    Attributes:
        number: of views.
        seed: of the views.
        distances: smallest and largest distance of the camera from the board, m; at the smallest,
            most of the board should be in the picture and sharp.
        max_tilt: largest angle of the camera's axis from the board's normal, rad.
    """

    number: int = 20
    seed: int = 0
    distances: tuple[float, float] = (0.36, 0.6)
    max_tilt: float = float(np.deg2rad(35.0))


DEFAULT_VIEWS = BoardViews()


class CellCalibration(NamedTuple):
    """The calibration of a cell, with the data it is based on.

    Attributes:
        fit: the staged and the joint fit.
        data: the detected points of the board.
        pictures: of the board, only those in which it was found.
    """

    fit: CalibrationFit
    data: Dataset
    pictures: tuple[UInt8[np.ndarray, "rows columns"], ...]


def calibrate_cell(
    cell: Cell,
    board: AbstractTarget,
    drawing: Calibration,
    arm: SerialArm | None = None,
    views: BoardViews = DEFAULT_VIEWS,
    progress: Callable[[str], None] | None = None,
) -> CellCalibration:
    """Take pictures of a board that lies in a cell, and fit the calibration to them.

    Views in which the board is not found are left out. Centres of circles with known radii are
    corrected for perspective.

    Args:
        cell: with the board in place.
        board: the board in the cell; its frame becomes the world.
        drawing: approximate poses of camera and board, used to plan the views.
        arm: the nominal arm, whose errors are estimated too; None if its joints are unknown.
        views: number of views, their distances and tilts.

    Raises:
        ValueError: the distances are not positive or out of order, the tilt is not below a right
            angle, or the board was found in fewer than `MIN_VIEWS` views.
        CellError: the robot does not reach a view.
    """
    if not 0.0 < views.distances[0] <= views.distances[1]:
        raise ValueError(f"distances: expected 0 < smallest <= largest, found {views.distances} m")
    if not 0.0 <= views.max_tilt < 0.5 * np.pi:
        raise ValueError(
            f"max_tilt: expected 0 to below {0.5 * np.pi:.3f} rad, found {views.max_tilt}"
        )
    say = progress or (lambda _: None)
    flat = board.flat_board
    pictures, detections, commands = [], [], []
    for k, pose in enumerate(_planned_views(board, views)):
        # Counted as planned, whether or not the board is found in it.
        say(f"calibrating: view {k + 1} of {views.number}")
        command = _command(cell, drawing, pose, arm)
        if command is None:
            continue
        reported, picture = cell.move(command), cell.picture()
        pixels = np.asarray(detect(picture, flat).pixels)
        # Half of the points constrain the view better than a few stray ones.
        if np.isfinite(pixels).all(axis=-1).sum() >= len(pixels) // 2:
            pictures.append(picture)
            detections.append(pixels)
            commands.append(reported)
    if len(detections) < MIN_VIEWS:
        raise ValueError(
            f"the board was found in {len(detections)} of {views.number} views; expected at least "
            f"{MIN_VIEWS}: is it where the drawing says?"
        )
    stacked = stacked_commands(commands)
    # Joints without an arm, or an arm without joints, cannot be used.
    with_joints = arm is not None and stacked.joints is not None
    height, width = pictures[0].shape
    data = Dataset.from_arrays(
        board.points,
        np.stack(detections),
        stacked.base_from_tool,
        image_size=(width, height),
        target=board,
        joints=stacked.joints if with_joints else None,
        arm=arm if with_joints else None,
    )
    # Other targets have corners, which perspective does not shift.
    corrected = data
    if isinstance(flat, CircleGrid) and flat.has_known_radii:
        # A rough calibration is enough: a tenth of a pixel is far more than the noise.
        corrected = correct_circle_centres(data, fit_staged(data).calibration)
    return CellCalibration(calibrate(corrected, progress=progress), data, tuple(pictures))


def _planned_views(board: AbstractTarget, views: BoardViews) -> Float[np.ndarray, "views 4 4"]:
    """Return `camera_from_world` of views of the board, tilted and rolled at random."""
    count, rng = views.number, np.random.default_rng((views.seed, 21))
    points = board.points
    size, middle = np.ptp(points, axis=0), points.mean(axis=0)
    # Off the middle, so that the corners of the picture contain points too.
    aims = middle + AIM_SPREAD * size * rng.uniform(-1.0, 1.0, (count, 3))
    azimuth, roll = rng.uniform(0.0, 2.0 * np.pi, (2, count))
    # The tilts alternate, so that even few views contain steep ones.
    tilt = views.max_tilt * (0.35 + 0.65 * (np.arange(count) % 2)) * rng.uniform(0.7, 1.0, count)
    above = board.y_up
    directions = np.asarray(viewing_direction(tilt, azimuth, above))
    # Half turns keep the picture's longer side along the board's; two and three of them equal none
    # and one.
    half_turns = np.floor(4.0 * roll / (2.0 * np.pi))
    rolls = np.pi * half_turns + rng.uniform(-0.4, 0.4, count)
    return host_matrices(look_at(aims, directions, rng.uniform(*views.distances, count), rolls))


def _command(
    cell: Cell,
    drawing: Calibration,
    camera_from_world: Float[np.ndarray, "4 4"],
    arm: SerialArm | None,
) -> Command | None:
    """Return the command for a view by the drawing; None if the nominal arm does not reach it."""
    pose = drawing.command_for(camera_from_world)
    joints = cell.where().joints
    if arm is None or joints is None:
        return Command(pose)
    # Near the current joints, so that the arm does not turn over between two views.
    solution = joints_for_pose(arm, pose, joints)
    return Command(pose, solution.joints) if bool(solution.is_solved) else None


def stacked_commands(commands: list[Command]) -> Command:
    """Return single commands as one batch."""
    poses = np.stack([np.asarray(command.base_from_tool.wxyz_xyz) for command in commands])
    joints = [command.joints for command in commands]
    known = all(readings is not None for readings in joints)
    return Command(
        type(commands[0].base_from_tool)(to_device(poses)),
        to_device(np.stack([np.asarray(readings) for readings in joints])) if known else None,
    )
