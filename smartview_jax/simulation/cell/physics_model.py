"""Write the MuJoCo model of a cell: table, bin, objects, and a gripper led along a path."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ...robots import Gripper
from .fixtures import FixedBox
from .objects import CellObject, as_box, convex_parts

TIME_STEP = 1e-3
"""Time step of the physics, s."""

CONTACT_TIME = 4e-3
"""Time constant of contacts, s; a resting object sinks in by less than a micrometre.

MuJoCo's contacts are springs with dampers; the constant is at least twice the time step.
"""

GRIP_FORCE = 20.0
"""Largest force of each finger, N."""

FINGER_GAIN = 4000.0
"""Force of a finger's drive per distance from its set point, N/m."""

GUIDE_HEIGHT = 3.0
"""Height of the walls that guide falling objects, m; they exist only while objects fall."""

GUIDE_THICKNESS = 0.05
"""Thickness of the walls that guide falling objects, m."""

PALM_MASS, FINGER_MASS = 0.6, 0.1
"""Masses of the gripper's parts, kg; its weight is carried by the arm."""

TEMPLATE = Path(__file__).with_name("model.xml")
"""The model with names in braces for the parts that depend on a cell."""


def physics_xml(
    objects: Sequence[CellObject],
    fixtures: Sequence[FixedBox],
    gripper: Gripper,
    guide_centre: tuple[float, float],
    guide_size: tuple[float, float],
) -> str:
    """Return the model in MuJoCo's format; its world is the cell's, z upwards.

    The gripper's body is welded to a massless target, which is moved along the path of the true
    tool; the fingers slide, coupled to each other, with a drive of limited force. The gripper
    collides with objects and fixtures, not with itself. Objects are named o0, o1, ...; the guiding
    walls have a middle and distances along x and y, m.
    """
    meshes: list[str] = []
    # Bits of contype and conaffinity: 1 for objects and fixtures, 2 for the gripper.
    bodies = [_object_xml(k, obj, meshes) for k, obj in enumerate(objects)]
    x, y = guide_centre
    # Infinitely heavy walls, thick so that nothing passes through in one step. Their inner sides
    # coincide with the bin's.
    offsets = [
        (sign * (0.5 * (guide_size[axis] + GUIDE_THICKNESS)), axis)
        for axis in (0, 1)
        for sign in (-1.0, 1.0)
    ]
    half = 0.5 * max(guide_size) + GUIDE_THICKNESS
    guides = []
    for k, (offset, axis) in enumerate(offsets):
        centre = [x, y, 0.5 * GUIDE_HEIGHT]
        centre[axis] += offset
        # Wide enough to meet at the corners.
        size = [half, half, 0.5 * GUIDE_HEIGHT]
        size[axis] = 0.5 * GUIDE_THICKNESS
        guides.append(
            f'    <geom name="guide{k}" type="box" pos="{_text(centre)}" size="{_text(size)}" '
            'contype="0" conaffinity="0" friction="0.05 0.005 0.0001"/>'
        )
    # Drawn closed; the joints move the fingers from there.
    boxes = {box.name: box for box in gripper.boxes(0.0)}
    parts = {
        name: f'<geom type="box" pos="{_text(box.centre)}" size="{_text(0.5 * box.size)}" '
        f'mass="{PALM_MASS if name == "palm" else FINGER_MASS}" contype="2" conaffinity="1" '
        'friction="1 0.005 0.0001"/>'
        for name, box in boxes.items()
    }
    return TEMPLATE.read_text().format(
        step=TIME_STEP,
        contact=CONTACT_TIME,
        meshes="\n".join(meshes),
        fixtures="\n".join(
            f'    <geom name="f{k}" type="box" pos="{_text(box.centre)}" '
            f'size="{_text(0.5 * np.asarray(box.size))}" contype="1" conaffinity="3"/>'
            for k, box in enumerate(fixtures)
        ),
        guides="\n".join(guides),
        palm=parts["palm"],
        left=parts["left finger"],
        right=parts["right finger"],
        reach=0.5 * gripper.max_opening,
        objects="\n".join(bodies),
        gain=FINGER_GAIN,
        force=GRIP_FORCE,
    )


def _object_xml(number: int, obj: CellObject, meshes: list[str]) -> str:
    """Return the body of an object, and add meshes for its parts that are no boxes."""
    geoms = []
    # The object's own friction is used, whatever it touches: its contacts take priority.
    common = (
        f'density="{obj.density}" friction="{obj.friction} 0.005 0.0001" priority="1" '
        'contype="1" conaffinity="3"'
    )
    for k, corners in enumerate(convex_parts(obj.solid, obj.name)):
        box = as_box(corners)
        if box is not None:
            quat = np.roll(Rotation.from_matrix(box.pose[:3, :3]).as_quat(), 1)
            geoms.append(
                f'<geom type="box" pos="{_text(box.pose[:3, 3])}" quat="{_text(quat)}" '
                f'size="{_text(0.5 * box.size)}" {common}/>'
            )
        else:
            meshes.append(f'    <mesh name="m{number}_{k}" vertex="{_text(corners.ravel())}"/>')
            geoms.append(f'<geom type="mesh" mesh="m{number}_{k}" {common}/>')
    inside = "\n      ".join(geoms)
    return (
        f'    <body name="o{number}">\n      <freejoint name="o{number}"/>\n      {inside}\n'
        "    </body>"
    )


def _text(numbers: Sequence[float] | np.ndarray) -> str:
    """Return numbers in MuJoCo's format, with every digit."""
    return " ".join(repr(float(x)) for x in numbers)
