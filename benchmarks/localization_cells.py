"""Scenes for localisation before an arm whose errors nobody is told: on the table and in the bin.

Objects stand on a table among clutter, or fall into a bin, so that poses and what hides them are
what gravity makes them. The arm is sent to two views; its pictures are taken from where its true
kinematics, mount and lens put the camera.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

import smartview_jax as sv
from smartview_jax.geometry import host_matrices, host_transforms, look_at
from smartview_jax.modeling import ObjectModel
from smartview_jax.robots import Command
from smartview_jax.simulation import (
    CellError,
    CellObject,
    Polyhedron,
    SimulatedCell,
    SolidScene,
    Surface,
    box,
    render_solids,
    speckled,
)

from .localization_scenes import (
    clutter,
    hidden_shares,
    occluder,
    plain_surfaces,
    printed_table,
    resting,
    similar_solids,
    solids,
)

KINDS = ("single", "occluded", "clutter", "bin", "wrong", "empty", "similar")
"""Alone, with some 30 % of its edges hidden, among clutter, 1 to 8 in a bin, another object than
those that are looked for, none, and solids like the one that is looked for but for their sizes."""

DISTANCE = (0.38, 0.46)
"""Distances of the cameras from the middle of the scene, m."""

TRIES = 20
"""Number of views, or of falls, that are tried until one can be had."""


class View(NamedTuple):
    """A picture, with what the robot reports of it and what is true.

    Attributes:
        command: as reported, with the joints' readings.
        base_from_tool: the true pose of the tool.
        picture: grey.
    """

    command: Command
    base_from_tool: np.ndarray
    picture: np.ndarray


class CellScene(NamedTuple):
    """A scene before the arm, with the truth.

    Attributes:
        kind: one of `KINDS`.
        seed: of everything in it.
        surfaces: all that is seen.
        objects: models of the objects in the scene.
        world_from_object: their true poses.
        others: names of absent models that are also looked for.
        views: two of them.
        hidden: share of the objects' edges that something else hides in each view.
    """

    kind: str
    seed: int
    surfaces: list[Surface]
    objects: list[ObjectModel]
    world_from_object: list[np.ndarray]
    others: list[str]
    views: list[View]
    hidden: np.ndarray


def true_calibration(cell: SimulatedCell) -> sv.Calibration:
    """Return the cell's true calibration, for true poses of the tool."""
    return cell.truth.calibration.uncorrected


def workspace_of(cell: SimulatedCell) -> np.ndarray:
    """Return the corners of the box above the table in which objects may be, m."""
    x, y = cell.centre[:2]
    return np.array([[x - 0.14, y - 0.14, 0.0], [x + 0.14, y + 0.14, 0.15]])


def cell_scene(cell: SimulatedCell, kind: str, seed: int) -> CellScene:
    """Return a scene of a kind before a cell's arm; the same seed gives the same one."""
    rng, names = np.random.default_rng((seed, KINDS.index(kind), 7)), list(solids())
    # Each object equally often, whatever the order in which scenes are made.
    order = names[seed % len(names) :] + names[: seed % len(names)]
    present = {"empty": 0, "similar": 0, "bin": 1 + (seed // len(names)) % 8}.get(kind, 1)
    objects = [solids()[name].exact_model(name) for name in (2 * order)[:present]]
    others = order[1:2] if kind == "bin" and present == 1 else order[present : present + 1]
    if kind in ("wrong", "empty"):
        others = order[1:3]
    shift = np.eye(4)
    shift[:2, 3] = cell.centre[:2]
    if kind == "bin":
        fallen = [CellObject(f"{k}", solids()[one.name]) for k, one in enumerate(objects)]
        _drop(cell, fallen, seed)
        truth = [cell.judge().world_from_object[one.name] for one in fallen]
        walls = [one.surface for one in cell.fixtures]
    else:
        cell.show_board()
        truth = [shift @ resting(solids()[one.name], rng) for one in objects]
        walls = []
    placed = [solids()[one.name].moved(pose) for one, pose in zip(objects, truth, strict=True)]
    poses = _commanded(cell, _aim(cell, placed, kind), rng)
    camera_poses = np.stack([_world_from_camera(cell, actual) for _, actual in poses])
    around = []
    if kind in ("clutter", "occluded", "empty", "wrong"):
        middle = placed[0] if placed else box(0.05, 0.05, 0.03).moved(shift)
        around = clutter(middle, rng)
    if kind == "similar":
        around = similar_solids(solids()[order[0]], cell.centre, rng)
    calibration = true_calibration(cell)
    if kind == "occluded":
        bar = occluder(objects[0], truth[0], camera_poses, calibration, rng, around)
        around.append(bar)
    hidden = _hidden(objects, truth, placed, around + _solid_walls(cell, kind), camera_poses, cell)
    surfaces = _surfaces(cell, placed, around, walls, kind, seed, rng)
    views = [
        View(command, actual, picture(cell, surfaces, actual, seed + k))
        for k, (command, actual) in enumerate(poses)
    ]
    return CellScene(kind, seed, surfaces, objects, truth, others, views, hidden)


def _drop(cell: SimulatedCell, objects: list[CellObject], seed: int) -> None:
    """Drop objects into the bin; try again where some of them do not come to rest."""
    for k in range(TRIES):
        try:
            return cell.drop(objects, seed + k * 1_000_000)
        except CellError:
            continue
    raise RuntimeError(f"{len(objects)} objects come to rest in none of {TRIES} falls")


def picture(
    cell: SimulatedCell, surfaces: list[Surface], base_from_tool: np.ndarray, seed: int
) -> np.ndarray:
    """Return the picture from a true pose of the tool."""
    return render_solids(
        true_calibration(cell),
        host_transforms(base_from_tool),
        SolidScene(surfaces),
        exposure=1.2,
        seed=seed,
        samples=16,
        stride=3,
    )


def taken(
    cell: SimulatedCell, scene: CellScene, camera_from_world: np.ndarray, seed: int
) -> View | None:
    """Return a further view; None where the arm does not reach it."""
    wanted = true_calibration(cell).command_for(host_transforms(camera_from_world))
    try:
        command = cell.move(host_matrices(wanted))
    except CellError:
        return None
    actual = cell.judge_tool()
    return View(command, actual, picture(cell, scene.surfaces, actual, seed))


def _aim(cell: SimulatedCell, placed: list[Polyhedron], kind: str) -> np.ndarray:
    """Return the point at which the camera looks."""
    if kind == "bin" or not placed:
        return np.array([*cell.centre[:2], 0.02])
    return placed[0].vertices.mean(axis=0)


def _commanded(
    cell: SimulatedCell, aim: np.ndarray, rng: np.random.Generator
) -> list[tuple[Command, np.ndarray]]:
    """Return two views from above, 20 to 35 degrees apart: as reported, and where the tool is."""
    for _ in range(TRIES):
        tilt, azimuth = rng.uniform(0.25, 0.6), rng.uniform(0.0, 2.0 * np.pi)
        apart = np.deg2rad(rng.uniform(20.0, 35.0)) / np.sin(max(tilt, 0.5))
        found = []
        for angle in (azimuth, azimuth + apart):
            direction = -np.array(
                [np.sin(tilt) * np.cos(angle), np.sin(tilt) * np.sin(angle), np.cos(tilt)]
            )
            target = aim + rng.uniform(-0.015, 0.015, 3)
            roll = rng.uniform(-np.pi, np.pi)
            wanted = look_at(target, direction, rng.uniform(*DISTANCE), roll)
            try:
                pose = true_calibration(cell).command_for(wanted)
                command = cell.move(host_matrices(pose))
            except CellError:
                break
            found.append((command, cell.judge_tool()))
        if len(found) == 2:
            return found
    raise RuntimeError(f"the arm reaches none of {TRIES} pairs of views")


def _world_from_camera(cell: SimulatedCell, base_from_tool: np.ndarray) -> np.ndarray:
    """Return where the camera really is."""
    pose = true_calibration(cell).camera_from_world(host_transforms(base_from_tool))
    return np.linalg.inv(host_matrices(pose))


def _solid_walls(cell: SimulatedCell, kind: str) -> list[Polyhedron]:
    """Return the walls of the bin, if there is one."""
    if kind != "bin":
        return []
    return [
        box(*fixture.size).moved(fixture.world_from_box @ _centred(fixture.size))
        for fixture in cell.fixtures
    ]


def walls_of(cell: SimulatedCell, kind: str) -> np.ndarray:
    """Return the triangles of the bin's walls in the world, m; none where there is no bin."""
    walls = [wall.vertices[wall.triangles] for wall in _solid_walls(cell, kind)]
    return np.concatenate([np.zeros((0, 3, 3)), *walls])


def _centred(size: np.ndarray) -> np.ndarray:
    """Return the pose at which a box of `simulation.box` has its middle in the origin."""
    pose = np.eye(4)
    pose[:3, 3] = -box(*size).vertices.mean(axis=0)
    return pose


def _hidden(
    objects: list[ObjectModel],
    truth: list[np.ndarray],
    placed: list[Polyhedron],
    around: list[Polyhedron],
    poses: np.ndarray,
    cell: SimulatedCell,
) -> np.ndarray:
    """Return the share of each object's visible edges that all else hides in each view."""
    shares = [
        hidden_shares(
            model, pose, poses, true_calibration(cell), [*placed[:k], *placed[k + 1 :], *around]
        )
        for k, (model, pose) in enumerate(zip(objects, truth, strict=True))
    ]
    return np.array(shares).reshape(len(objects), len(poses))


def _surfaces(
    cell: SimulatedCell,
    placed: list[Polyhedron],
    around: list[Polyhedron],
    walls: list[Surface],
    kind: str,
    seed: int,
    rng: np.random.Generator,
) -> list[Surface]:
    """Return all that is seen: a printed table, objects with grain, plain clutter, the bin."""
    printed = printed_table(12 if kind in ("single", "bin") else 30, seed, rng)
    x, y = cell.centre[:2]
    turn = Rotation.from_euler("z", rng.uniform(0.0, 6.3)).as_matrix()[:2, :2]

    def about_centre(points: np.ndarray) -> np.ndarray:
        moved = points.copy()
        moved[:, :2] = (points[:, :2] - [x, y]) @ turn
        return printed(moved)

    surfaces = [Surface.of_plane(0.7, about_centre)]
    for k, one in enumerate(placed):
        grain = speckled(rng.uniform(0.55, 0.8), rng.uniform(0.0, 0.03), 0.003, seed=seed + 7 * k)
        surfaces.append(Surface.of_polyhedron(one, grain))
    return surfaces + plain_surfaces(around, rng) + walls
