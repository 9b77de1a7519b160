"""Run the paper's whole story in a simulated cell: calibrate, model, localise, verify, grasp."""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from ..cameras import Camera, Pinhole
from ..files import write_atomically
from ..geometry import (
    host_matrices,
    host_poses,
    host_transformed,
    host_transforms,
    look_at,
    viewing_direction,
)
from ..grasping import GraspScene, Obstacle
from ..localization import Localization
from ..modeling import Face, ObjectModel, command_at, face_plane
from ..report import write_story
from ..robots import Command
from ..simulation import (
    CellObject,
    Polyhedron,
    SimulatedCell,
    box,
    drawn_calibration,
    roofed_block,
    stepped_block,
)
from ..viewpoints import viewpoint_commands
from .calibrating import BoardViews, CellCalibration, calibrate_cell, stacked_commands
from .clicking import SeenObject, model_by_clicks
from .looking import Region
from .pick import Pick, pick
from .story import (
    grasp_section,
    localised_section,
    model_section,
    numbers_section,
    verdict_sentence,
)

MODEL_VIEWS, MODEL_TILT, MODEL_DISTANCE = 6, float(np.deg2rad(38.0)), 0.33
"""Views of the object that is modelled, all around it: number, tilt (rad), distance (m)."""

BYSTANDER_SIZE, BYSTANDER_FOCAL = (640, 480), 900.0
"""Pictures of the bystander camera, which watches the grasp: size and focal length, px."""


class DemoResult(NamedTuple):
    """The outcome of the demo, compared with the true state of the simulation.

    Attributes:
        held: whether the chosen object is in the hand, by the physics.
        pick: the attempt.
        model: the clicked model of one of the objects.
        position_error: distance of the localised object from the true one, m; NaN without one.
    """

    page: Path
    held: bool
    pick: Pick
    calibration: CellCalibration
    model: ObjectModel
    position_error: float


def run_demo(
    out: Path, seed: int = 0, views: int = 16, progress: Callable[[str], None] | None = None
) -> DemoResult:
    """Calibrate a simulated cell, model an object, find, verify and grasp one, and write a page.

    The object that was modelled falls into a bin with two others, whose exact models are known; the
    one with the safest grasp is picked.

    Args:
        seed: random seed of the cell and of the objects' fall.
        progress: called with a line of text for each step.

    Raises:
        ImportError: a package of smartview-jax[cell] is not installed.
    """
    say = progress or (lambda _: None)
    out.mkdir(parents=True, exist_ok=True)
    times: list[tuple[str, float]] = []
    start = time.perf_counter()

    def done(name: str) -> None:
        nonlocal start
        times.append((name, time.perf_counter() - start))
        start = time.perf_counter()

    # Apart from the judge, everything below uses only the methods of any cell.
    cell = SimulatedCell(seed)
    calibrated = calibrate_cell(
        cell, cell.board, drawn_calibration(), cell.arm, BoardViews(views, seed), progress
    )
    done(f"calibration from {len(calibrated.pictures)} pictures")
    say("modelling: pictures all around the object")
    block = CellObject("stepped block", stepped_block(0.06))
    # In a separate folder: a session would continue with the clicks of an earlier run.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "object.json"
        model, model_pictures, model_poses = modelled(cell, calibrated, block, path)
        write_atomically(out / path.name, path.read_bytes())
    done(f"model from {len(model_pictures)} pictures by scripted clicks")
    say("three objects fall into the bin")
    others = [CellObject("box", box(0.05, 0.035, 0.03)), CellObject("house", roofed_block(0.045))]
    cell.drop([block, *others], seed)
    models = [model, *(obj.solid.exact_model(obj.name) for obj in others)]
    strip = [("before", watched(cell))]
    region = Region(cell.centre, (0.24, 0.18, 0.12))
    # Ask the judge before the grasp moves the object.
    before = cell.judge().world_from_object
    attempt = pick(
        cell, models, cell.gripper, region, _grasp_scene(cell, calibrated),
        progress=progress, after=lambda phase: strip.append((phase, watched(cell))),
    )  # fmt: skip
    done("looking, verifying, planning and grasping")
    held, error = False, float("nan")
    if attempt.target is not None:
        chosen = attempt.target.model
        held = chosen.name in cell.judge().held
        # The clicked model's frame is the world's at the place where the object stood alone.
        origin = cell.centre if chosen is model else np.zeros(3)
        error = position_error(attempt.target, before[chosen.name], origin)
    page = out / "demo.html"
    say("writing the page")
    sections = [model_section(model, model_pictures, model_poses, calibrated)]
    # A run that ended at its first pictures has no Fig. 8.
    if attempt.look is not None:
        sections.append(localised_section(attempt.look, calibrated, region, strip))
    sections.append(grasp_section(attempt, strip))
    sections.append(numbers_section(attempt, calibrated, model, error, held, times))
    write_story(
        page, "From a board to an object in the hand", verdict_sentence(attempt, held), sections
    )
    return DemoResult(page, held, attempt, calibrated, model, error)


def _grasp_scene(cell: SimulatedCell, calibrated: CellCalibration) -> GraspScene:
    """Return the calibrated arm with the table and the walls of the bin."""
    walls = [Obstacle.box(wall.name, wall.size, wall.world_from_box) for wall in cell.fixtures]
    return GraspScene(
        calibrated.fit.calibration,
        (Obstacle.table(), *walls),
        arm=cell.arm,
        near=np.asarray(cell.where().joints),
        estimate=calibrated.fit.joint,
        link_radius=0.04,
    )


def modelled(
    cell: SimulatedCell, calibrated: CellCalibration, block: CellObject, path: Path
) -> tuple[ObjectModel, list[np.ndarray], Command]:
    """Return the model of an object alone in the cell, its pictures and the reported poses."""
    # At the place of the board, where the calibration is best.
    cell.place([block], [host_poses(np.eye(3), cell.centre)])
    calibration = calibrated.fit.calibration
    solid = block.solid.moved(cell.judge().world_from_object[block.name])
    aim = solid.vertices.mean(axis=0)
    # Evenly spaced, and not along the sides of the object.
    azimuths = 2.0 * np.pi * np.arange(MODEL_VIEWS) / MODEL_VIEWS + 0.3
    directions = np.asarray(viewing_direction(np.full(MODEL_VIEWS, MODEL_TILT), azimuths))
    near = np.asarray(cell.where().joints)
    # All around, as far as the arm reaches.
    planned = viewpoint_commands(
        calibration, look_at(aim, directions, MODEL_DISTANCE), arm=cell.arm, near=near
    )
    reached = np.flatnonzero([not r for r in planned.checks.reasons(("reach", "tool_distance"))])
    pictures, commands, seen_pixels, visible = [], [], [], []
    truth = cell.truth.calibration.uncorrected
    for k in reached.tolist():
        commands.append(cell.move(command_at(planned.command, k)))
        pictures.append(cell.picture())
        # The script clicks where a person would: at the corners' true pixels.
        actual = host_transforms(cell.judge_tool())
        seen_pixels.append(np.asarray(truth.project(actual, solid.vertices)[0]))
        centre = np.linalg.inv(host_matrices(truth.camera_from_world(actual)))[:3, 3]
        visible.append(_visible_vertices(solid, centre))
    stacked = stacked_commands(commands)
    model = model_by_clicks(
        calibration,
        calibrated.fit.joint,
        stacked,
        pictures,
        SeenObject(np.stack(seen_pixels), np.stack(visible), block.solid.faces, block.name),
        path,
    )
    return model, pictures, stacked


def _visible_vertices(
    solid: Polyhedron, centre: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, "vertices"]:
    """Return which vertices belong to a face that faces a camera."""
    visible = np.zeros(len(solid.vertices), bool)
    for loop in solid.faces:
        plane = face_plane(solid.vertices, Face(tuple(loop)))
        if plane.normal @ (centre - plane.origin) > 0.0:
            visible[list(loop)] = True
    return visible


def watched(cell: SimulatedCell) -> UInt8[np.ndarray, "rows columns"]:
    """Return the bystander camera's picture of the bin."""
    width, height = BYSTANDER_SIZE
    camera = Camera(
        BYSTANDER_FOCAL, BYSTANDER_FOCAL, 0.5 * width, 0.5 * height, Pinhole(), (width, height)
    )
    # Aimed above the bin, so that the lifted object is in the picture too.
    aim = cell.centre + np.array([0.0, 0.0, 0.09])
    pose = host_matrices(look_at(aim, np.array([-0.35, 1.0, -0.55]), 0.75))
    return cell.watch(pose, camera)


def position_error(
    target: Localization, truth: Float[np.ndarray, "4 4"], origin: np.ndarray
) -> float:
    """Return the distance of the localised object's middle from the true one, m.

    The clicked model's frame is the world's at the time of modelling, when the object stood at the
    known place `origin`.
    """
    middle = target.model.vertices.mean(axis=0)
    estimated = host_transformed(target.world_from_object, middle)
    return float(np.linalg.norm(estimated - host_transformed(truth, middle - origin)))
