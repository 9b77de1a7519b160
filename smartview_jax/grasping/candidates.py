"""List the grasps of an object that a gripper allows, regardless of the surroundings."""

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..modeling import (
    Grasp,
    ObjectModel,
    grasp_on_face,
    width_between_fingers,
    widths_between_fingers,
)
from ..robots import Gripper

SUGGESTED_CLEARANCE = 8e-3
"""Clearance between each open finger and the object in a suggested grasp, m."""

SPARE_DEPTH = 3e-3
"""Length of the object that a suggested grasp leaves below the fingertips, m."""

REVOLUTION_STEPS = 12
"""Number of turns at which a grasp is repeated about the axis of a surface of revolution."""

FINGER_STEPS = 8
"""Number of places along a finger's width at which the object's width is measured."""

SHIFTS = (0.0, 0.25, -0.25)
"""Positions of suggested grasps along the fingers' width, over the object's extent there."""


class Candidate(NamedTuple):
    """A grasp of the model, repeated by the model's and the gripper's symmetry.

    Attributes:
        object_from_gripper: pose of the gripper's frame in the object's, m.
        opening: distance between the fingers while they approach, m.
        width: width of the object between the fingers, m.
        along_finger: lower and upper end of the object's two sides along the gripper's y axis, from
            the middle of the fingers, m.
    """

    grasp: Grasp
    object_from_gripper: Float[np.ndarray, "4 4"]
    opening: float
    width: float
    along_finger: tuple[float, float]


def suggested_grasps(model: ObjectModel, gripper: Gripper) -> tuple[Grasp, ...]:
    """Return grasps on every pair of parallel faces that the fingers reach around.

    The fingers touch the pair, and the gripper approaches along the inward normal of a face that is
    perpendicular to it. Faces marked as not graspable are not touched.

    Missing faces, such as the bottom of a clicked model, are neither touched nor approached.

    Raises:
        ValueError: the model has no faces, which are needed for widths.
    """
    if not model.faces:
        raise ValueError(f"model {model.name!r} has neither grasps nor faces to put any on")
    planes = [model.plane(k) for k in range(len(model.faces))]
    grasps = []
    for a, first in enumerate(planes):
        for b in range(a + 1, len(planes)):
            touched = (
                model.faces[a].graspable is not False and model.faces[b].graspable is not False
            )
            width = float(first.normal @ (first.origin - planes[b].origin))
            # Opposite normals that point away from each other, unlike two walls of a groove.
            opposite = first.normal @ planes[b].normal < -1.0 + 1e-4
            if not (touched and opposite and 0.0 < width < gripper.max_opening):
                continue
            middle = 0.5 * (_face_centre(model, a) + _face_centre(model, b))
            for f, plane in enumerate(planes):
                if abs(plane.normal @ first.normal) < 1e-2:
                    grasps += _grasps_between(model, gripper, f, first.normal, middle, width)
    return tuple(grasps)


def _face_centre(model: ObjectModel, face: int) -> Float[np.ndarray, "3"]:
    """Return the middle of a face's corners, m."""
    return model.vertices[model.faces[face].indices].mean(axis=0)


def _grasps_between(
    model: ObjectModel,
    gripper: Gripper,
    face: int,
    direction: Float[np.ndarray, "3"],
    middle: Float[np.ndarray, "3"],
    width: float,
) -> Iterator[Grasp]:
    """Yield the grasps that approach along a face's normal and close along a direction."""
    normal = model.plane(face).normal
    heights = (model.vertices - model.plane(face).origin) @ normal
    # Down to slightly below the object's middle, as far as fingers and object are long enough.
    depth = min(
        float((model.plane(face).origin - middle) @ normal) + gripper.min_hold,
        float(np.ptp(heights)) - SPARE_DEPTH,
        gripper.finger_length - SPARE_DEPTH,
    )
    # The direction of the fingers' width, in the plane of the face.
    across = np.cross(normal, direction)
    extent = float(np.ptp(model.vertices @ across))
    opening = min(gripper.max_opening, width + 2.0 * SUGGESTED_CLEARANCE)
    for shift in SHIFTS:
        try:
            grasp = grasp_on_face(
                model,
                face,
                middle + shift * extent * across,
                direction,
                opening,
                depth,
                f"face {face}, {1e3 * width:.3g} mm wide",
            )
        except ValueError:
            # Not on the face, or too wide at the fingertips: no grasp there.
            continue
        reached = width_between_fingers(model, grasp.object_from_tool)
        # If the fingers would meet other faces than the pair, these need not be parallel.
        if reached is not None and abs(reached - width) < 1e-3 * width:
            yield grasp


def candidate_grasps(model: ObjectModel, gripper: Gripper) -> list[Candidate]:
    """Return all candidates of a model: its grasps, repeated by symmetry and by half a turn.

    A model without grasps gets `suggested_grasps`.
    """
    # Grasps that a person placed are preferred to suggested ones.
    grasps = model.grasps or suggested_grasps(model, gripper)
    candidates = []
    for grasp in grasps:
        width = width_between_fingers(model, grasp.object_from_tool)
        if width is None:
            # For an open model, use the width implied by the person's tolerance.
            width = max(grasp.opening - 2.0 * grasp.tolerance, 0.0)
        interval = _contact_interval(model, gripper, grasp, width)
        # With the grasp's opening, and with the largest one, which tolerates larger errors.
        openings = {min(grasp.opening, gripper.max_opening), gripper.max_opening}
        for object_from_object in _symmetry_transforms(model):
            for half_turn in (False, True):
                pose = object_from_object @ grasp.object_from_tool
                ends = interval
                if half_turn:
                    pose = pose @ np.diag([-1.0, -1.0, 1.0, 1.0])
                    ends = (-interval[1], -interval[0])
                candidates += [
                    Candidate(grasp, pose, opening, width, ends) for opening in sorted(openings)
                ]
    return candidates


def _symmetry_transforms(model: ObjectModel) -> Float[np.ndarray, "K 4 4"]:
    """Return the transforms that map the object onto itself; the identity comes first."""
    if model.symmetry is None or model.symmetry.axis is None:
        return model.object_from_object
    # Any turn about the axis is a symmetry; a few of them represent all.
    angles = 2.0 * np.pi * np.arange(REVOLUTION_STEPS) / REVOLUTION_STEPS
    turns = Rotation.from_rotvec(angles[:, None] * model.symmetry.axis).as_matrix()
    revolution = dataclasses.replace(model.symmetry, rotations=turns)
    return revolution.object_from_object


def _contact_interval(
    model: ObjectModel, gripper: Gripper, grasp: Grasp, width: float
) -> tuple[float, float]:
    """Return the range of shifts along the gripper's y axis that keep the object's width, m.

    Shifts of up to a finger's width to either side of the grasp are tested.
    """
    # Twice half a finger's width: an object may shift along the finger and still be held.
    steps = gripper.finger_width * np.linspace(0.0, 1.0, FINGER_STEPS + 1)[1:]
    offsets = np.concatenate([-steps, steps])
    poses = np.tile(grasp.object_from_tool, (len(offsets), 1, 1))
    poses[:, :3, 3] += offsets[:, None] * poses[:, :3, 1]
    widths = widths_between_fingers(model, poses)
    # NaN, outside the object, compares as False.
    as_wide = (np.abs(widths - width) <= 0.05 * width).reshape(2, -1)
    # The number of steps before the first one with another width.
    counts = np.cumprod(as_wide, axis=1).sum(axis=1)
    ends = [float(steps[n - 1]) if n else 0.0 for n in counts]
    return -ends[0], ends[1]
