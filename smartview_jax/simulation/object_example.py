"""Simulate the input for an object model: pictures of a board and of an object.

One rig takes both: the paper's camera and distance (`simulation.paper`), five viewpoints of a
polyhedral object in the paper's pattern (Fig. 6), and pictures of a circle grid that calibrate the
rig. The middle one of the five looks down obliquely, so that sides of the object are visible too.
The object has texture and stands among printed and solid clutter; there are shadows.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import UInt8

from ..calibration import Calibration
from ..files import write_atomically
from ..geometry import FIVE_VIEWPOINT_STEP, five_viewpoints, host_matrices
from ..io import write_object_views
from ..targets import CircleGrid, StackedTarget
from .polyhedra import Polyhedron, box, stepped_block
from .render import write_pictures
from .scenes import paper_calibration, random_viewpoints, reported_poses
from .solid_scenes import SolidScene, Surface, render_solids
from .textures import labelled, speckled

BOARD = StackedTarget(CircleGrid(7, 9, 0.0045, origin_mark=True), (0.0,))
"""The board of the example; a marked corner makes its orientation unique."""

BOARD_CENTRE = BOARD.points.mean(axis=0)
"""The middle of the board's points, m."""

BOARD_VIEWS = 12
"""Number of pictures of the board."""

DISTANCE = 0.2
"""Distance from the camera to its point of aim, m, as in the paper."""

TILT = float(np.deg2rad(32.0))
"""Angle of the middle viewpoint of the five from the vertical, rad."""

ROLLS = (0.0, 0.25, -0.3, 0.2, -0.15)
"""Rotations of the five viewpoints about their optical axes, rad."""

TRANSLATION_NOISE, ROTATION_NOISE = 3e-5, float(np.deg2rad(0.005))
"""Standard deviations of the robot's error per axis, m and rad."""


EXPOSURE = 1.3
"""Exposure of the object's pictures, whose sides are dim."""


class ObjectExample(NamedTuple):
    """Pictures of an object, the robot's reported poses, and the true values.

    Attributes:
        pictures: five pictures of the object.
        reported: `base_from_tool`, `(5)`, as the robot reported it.
        base_from_tool: the true poses.
        calibration: the true calibration; its world is the board's frame, which also contains the
            object.
        solid: the object in the world's frame.
    """

    pictures: tuple[UInt8[np.ndarray, "rows columns"], ...]
    reported: SE3
    base_from_tool: SE3
    calibration: Calibration
    solid: Polyhedron


def object_example(seed: int = 0, pattern: str = "cross") -> ObjectExample:
    """Return five pictures of the example's object, rendered in a few seconds.

    Args:
        seed: seed of the noise of camera and robot; the scene is always the same.
        pattern: arrangement of the viewpoints, as in `five_viewpoints`.

    Raises:
        ImportError: trimesh or embreex is not installed (smartview-jax[objects]).
    """
    truth, solid = paper_calibration(), example_solid()
    scene = _example_scene(solid)
    poses = truth.command_for(_tilted_viewpoints(solid.vertices.mean(axis=0), pattern))
    # A separate generator for the robot, so that the number of boards does not change its noise.
    rng = np.random.default_rng((seed, 1))
    pictures = tuple(
        render_solids(truth, pose, scene, exposure=EXPOSURE, seed=5 * seed + k, samples=16)
        for k, pose in enumerate(host_matrices(poses))
    )
    reported = reported_poses(poses, rng, TRANSLATION_NOISE, ROTATION_NOISE)
    return ObjectExample(pictures, reported, poses, truth, solid)


def example_solid() -> Polyhedron:
    """Return the object of the example at its pose: on the board's plane, at its centre."""
    return stepped_block(0.026).moved(_placed(0.5, [*BOARD_CENTRE[:2], 0.0]))


def _tilted_viewpoints(aim: np.ndarray, pattern: str) -> SE3:
    """Return `camera_from_world` of the five viewpoints about an oblique viewing direction."""
    upright = five_viewpoints(
        np.zeros(3), DISTANCE, np.array(ROLLS), FIVE_VIEWPOINT_STEP, pattern=pattern
    )
    # The whole pattern is turned about the aim, towards the lit side of the object:
    # pattern_from_world = Rx(-tilt) (p - aim).
    turn = SO3.from_x_radians(jnp.asarray(-TILT))
    return upright @ SE3.from_rotation_and_translation(turn, -(turn @ jnp.asarray(aim)))


def _example_scene(solid: Polyhedron) -> SolidScene:
    """Return the object on a printed table among two boxes."""
    centre = BOARD_CENTRE
    # Textures are functions of their own frame; centre them at the object.
    printed = labelled(speckled(0.5, 0.1, 0.0025, seed=3), 40, 0.014, 0.06, seed=4)
    # Low boxes at the border of the pictures: clutter with its own edges and shadows.
    boxes = [
        box(*size).moved(_placed(angle, np.add(centre, [x, y, 0.0])))
        for size, angle, x, y in (
            ((0.012, 0.008, 0.006), 0.9, -0.026, 0.014),
            ((0.009, 0.014, 0.005), 0.2, 0.03, 0.006),
        )
    ]
    cast = labelled(speckled(0.72, 0.06, 0.0012, seed=1), 7, 0.006, 0.014, seed=9)
    return SolidScene(
        (
            Surface.of_plane(0.3, lambda points: printed(points - centre)),
            Surface.of_polyhedron(solid, lambda points: cast(points - centre)),
            *(
                Surface.of_polyhedron(clutter, speckled(0.35, 0.05, 0.002, seed=5))
                for clutter in boxes
            ),
        )
    )


def _placed(angle: float, position: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return the pose of an object that is turned about z and then moved, m."""
    turn = SO3.from_z_radians(angle)
    return host_matrices(SE3.from_rotation_and_translation(turn, jnp.asarray(position)))


class BoardPoses(NamedTuple):
    """The robot's poses for the pictures of the board.

    Attributes:
        reported: `base_from_tool`, as the robot reported it.
        base_from_tool: the true poses.
        calibration: the true calibration.
    """

    reported: SE3
    base_from_tool: SE3
    calibration: Calibration


def object_example_boards(seed: int = 0) -> BoardPoses:
    """Return the poses of the example's pictures of its board, tilted and rolled at random."""
    truth, rng = paper_calibration(), np.random.default_rng((seed, 2))
    tilt = float(np.deg2rad(35.0))
    views = random_viewpoints(rng, BOARD_VIEWS, BOARD_CENTRE, (0.19, 0.23), tilt)
    poses = truth.command_for(views)
    reported = reported_poses(poses, rng, TRANSLATION_NOISE, ROTATION_NOISE)
    return BoardPoses(reported, poses, truth)


def write_object_example(
    folder: str | Path, seed: int = 0, pattern: str = "cross", suffix: str = ".png"
) -> Path:
    """Write the example as a user would have it, together with the true values.

    The folder itself is the data set of the board's pictures, which `load_dataset` reads and
    `calibrate` fits; `object` has the pictures of the object, for `load_object_views`; and
    `truth.json` the vertices and faces of the object in the board's frame, m.

    Args:
        seed: seed of the noise of camera and robot.
        pattern: arrangement of the viewpoints, as in `five_viewpoints`.
        suffix: kind of the picture files.
    """
    folder, example, boards = (
        Path(folder),
        object_example(seed, pattern),
        object_example_boards(seed),
    )
    write_pictures(
        folder,
        boards.calibration,
        boards.base_from_tool,
        BOARD,
        boards.reported,
        samples=3,
        suffix=suffix,
    )
    names = [f"object_{k}" for k in range(len(example.pictures))]
    write_object_views(folder / "object", names, example.pictures, example.reported, suffix)
    # In the board's frame, as results of a calibration with these pictures.
    content = {
        "unit": "m",
        "frame": "world",
        "vertices": example.solid.vertices.tolist(),
        "faces": [list(face) for face in example.solid.faces],
    }
    write_atomically(folder / "truth.json", json.dumps(content, indent=1))
    return folder
