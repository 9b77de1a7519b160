"""List the ways in which a gripper could hold an object, before anything around it is looked at."""

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
"""Number of places along a finger's width at which the object's width is looked at."""

SHIFTS = (0.0, 0.25, -0.25)
"""Places of suggested grasps along the fingers' width, over the object's extent there."""


class Candidate(NamedTuple):
    """A grasp of the model, repeated by its symmetry and by that of the gripper.

    Attributes:
        grasp: the model's grasp.
        object_from_gripper: pose of the gripper's frame in the object's, m.
        opening: distance between the fingers while they approach, m.
        width: how wide the object is between the fingers, m.
        along_finger: how far the object's two sides extend to either side of the fingers' middle,
            along the gripper's y axis, m: the lower and the upper end.
    """

    grasp: Grasp
    object_from_gripper: Float[np.ndarray, "4 4"]
    opening: float
    width: float
    along_finger: tuple[float, float]


def suggested_grasps(model: ObjectModel, gripper: Gripper) -> tuple[Grasp, ...]:
    """Return grasps on every pair of parallel faces that the fingers reach around.

    The fingers touch the pair, and the gripper approaches along the inward normal of a face at a
    right angle to it. Faces marked as not graspable are not touched.

    A face that the model lacks, as a clicked one often lacks its bottom, is neither touched nor
    approached.

    Raises:
        ValueError: the model has no faces at all, from which widths could be taken.
    """
    if not model.faces:
        raise ValueError(f"model {model.name!r} has neither grasps nor faces to put any on")
    planes = [model.plane(k) for k in range(len(model.faces))]
    found = []
    for a, first in enumerate(planes):
        for b in range(a + 1, len(planes)):
            touched = (
                model.faces[a].graspable is not False and model.faces[b].graspable is not False
            )
            width = float(first.normal @ (first.origin - planes[b].origin))
            # Opposite normals, and outside of each other, not two walls of a groove.
            opposite = first.normal @ planes[b].normal < -1.0 + 1e-4
            if not (touched and opposite and 0.0 < width < gripper.max_opening):
                continue
            middle = 0.5 * (_face_centre(model, a) + _face_centre(model, b))
            for f, plane in enumerate(planes):
                if abs(plane.normal @ first.normal) < 1e-2:
                    found += _grasps_between(model, gripper, f, first.normal, middle, width)
    return tuple(found)


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
    # Down to the object's middle and a little further, if fingers and object are long enough.
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
            # Beside the face, or too wide at the fingertips: no grasp there.
            continue
        reached = width_between_fingers(model, grasp.object_from_tool)
        # Where the fingers would meet other faces than the pair, these need not be parallel.
        if reached is not None and abs(reached - width) < 1e-3 * width:
            yield grasp


def candidate_grasps(model: ObjectModel, gripper: Gripper) -> list[Candidate]:
    """Return all candidates of a model: its grasps, repeated by symmetry and by half a turn.

    Without grasps of its own, those of `suggested_grasps` are taken.

    Raises:
        ValueError: the model has neither grasps nor faces.
    """
    # What a person placed is preferred to what is only possible.
    grasps = model.grasps or suggested_grasps(model, gripper)
    found = []
    for grasp in grasps:
        width = width_between_fingers(model, grasp.object_from_tool)
        if width is None:
            # Of an open model only what the person allowed is known.
            width = max(grasp.opening - 2.0 * grasp.tolerance, 0.0)
        interval = _contact_interval(model, gripper, grasp, width)
        # As wide as the grasp says, and as wide as the gripper goes, which forgives more.
        openings = {min(grasp.opening, gripper.max_opening), gripper.max_opening}
        for object_from_object in _symmetry_transforms(model):
            for half_turn in (False, True):
                pose = object_from_object @ grasp.object_from_tool
                ends = interval
                if half_turn:
                    pose = pose @ np.diag([-1.0, -1.0, 1.0, 1.0])
                    ends = (-interval[1], -interval[0])
                found += [
                    Candidate(grasp, pose, opening, width, ends) for opening in sorted(openings)
                ]
    return found


def _symmetry_transforms(model: ObjectModel) -> Float[np.ndarray, "K 4 4"]:
    """Return the transforms that map the object onto itself; the identity comes first."""
    if model.symmetry is None or model.symmetry.axis is None:
        return model.object_from_object
    # Any turn about the axis will do; some of them stand for all.
    angles = 2.0 * np.pi * np.arange(REVOLUTION_STEPS) / REVOLUTION_STEPS
    turns = Rotation.from_rotvec(angles[:, None] * model.symmetry.axis).as_matrix()
    revolution = dataclasses.replace(model.symmetry, rotations=turns)
    return revolution.object_from_object


def _contact_interval(
    model: ObjectModel, gripper: Gripper, grasp: Grasp, width: float
) -> tuple[float, float]:
    """Return between which shifts along the gripper's y axis the object keeps its width, m.

    Shifts of up to a finger's width are looked at, to either side of the grasp.
    """
    # Twice as far as half a finger: an object may shift along it and still be held.
    steps = gripper.finger_width * np.linspace(0.0, 1.0, FINGER_STEPS + 1)[1:]
    offsets = np.concatenate([-steps, steps])
    poses = np.tile(grasp.object_from_tool, (len(offsets), 1, 1))
    poses[:, :3, 3] += offsets[:, None] * poses[:, :3, 1]
    widths = widths_between_fingers(model, poses)
    # NaN, beside the object, compares as false.
    as_wide = (np.abs(widths - width) <= 0.05 * width).reshape(2, -1)
    # The steps up to the first that is not as wide.
    counts = np.cumprod(as_wide, axis=1).sum(axis=1)
    ends = [float(steps[n - 1]) if n else 0.0 for n in counts]
    return -ends[0], ends[1]
