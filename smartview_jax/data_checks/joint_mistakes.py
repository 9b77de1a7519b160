"""Name the usual mistakes in joint readings, and in the description of the arm that has them.

Poses that were computed from joints cannot have been read in a wrong format, but a joint may count
the other way round, have another zero or another unit, stand in another column (ROS sorts joints by
their names), or turn with its neighbour (Fanuc's third joint with the second). Each is reversed in
the readings, and the poses that the arm then has are compared with the camera's, as the mistakes in
poses are (`conventions.py`).
"""

import dataclasses
import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float

from ..calibration import mount_frames
from ..geometry import host_matrices
from ..robots import SerialArm
from .closure import MAX_CORRECTED_SCORE_RATIO, ClosureError, closure_error, closure_errors
from .convention_hypotheses import ANGLE_TOLERANCE, motions_of_mount
from .convention_texts import MAX_RIVAL_SCORE_RATIO, closure_error_text

Readings = Float[np.ndarray, "views joints"]
"""Joint readings, rad, or m for a prismatic joint."""

ZEROS = (90.0, -90.0, 180.0)
"""Zeros of a joint in other descriptions of the same arm, degrees from the given one."""

MAX_NAMED = 3
"""Largest number of mistakes that are named where several explain the data about as well."""

OTHER_ARM_RATIO = 1.05
"""Ratio of the motions of camera and arm, either way, from which the arm may be another one: the
links of one type are alike to a thousandth, links of two types of a maker differ by more."""

OTHER_ARM_TEXT = (
    "or is the arm of another type than described, whose links are longer or shorter by as much?"
)
"""What else may be wrong where the target seems to have another size and joints gave the poses."""


class JointMistake(NamedTuple):
    """A mistake in joint readings or in the description of their arm, and the data without it.

    Attributes:
        description: what was done wrong, as a clause.
        readings: without the mistake.
        arm: without the mistake.
    """

    description: str
    readings: Readings
    arm: SerialArm


def joint_mistakes(readings: Readings, arm: SerialArm) -> Iterator[JointMistake]:
    """Yield every mistake that is known, mistakes of single joints first.

    The zeros of the first and of the last joint are left out: base and mount turn with them.
    """
    count, revolute = arm.joint_count, ~np.array(arm.prismatic)
    for joint in range(count):
        corrected = readings.copy()
        corrected[:, joint] *= -1.0
        yield JointMistake(f"joint {joint + 1} counts the other way round", corrected, arm)
    for joint in np.flatnonzero(revolute[1:-1]) + 1:
        for degrees in ZEROS:
            corrected = readings.copy()
            corrected[:, joint] -= np.deg2rad(degrees)
            yield JointMistake(
                f"the zero of joint {joint + 1} is {degrees:+.0f} degrees off", corrected, arm
            )
    for first, second in itertools.combinations(range(count), 2):
        order = np.arange(count)
        order[[first, second]] = second, first
        yield JointMistake(
            f"joints {first + 1} and {second + 1} stand in each other's column",
            readings[:, order],
            arm,
        )
    yield JointMistake("the joints stand in reverse order", readings[:, ::-1], arm)
    for factor, words in (
        (np.pi / 180.0, "the readings are degrees, not radians: state angle_unit: deg"),
        (180.0 / np.pi, "the readings are radians, not degrees: state angle_unit: rad"),
    ):
        yield JointMistake(words, np.where(revolute, factor, 1.0) * readings, arm)
    yield from _mistakes_of_units(readings, arm)
    yield from _coupled_joints(readings, arm)
    other = "modified" if arm.convention == "standard" else "standard"
    yield JointMistake(
        f"the Denavit-Hartenberg parameters are {other} ones: state convention: {other}",
        readings,
        dataclasses.replace(arm, convention=other),
    )


def _mistakes_of_units(readings: Readings, arm: SerialArm) -> Iterator[JointMistake]:
    """Yield the mistakes of a single joint that is read in another unit of angle."""
    for joint in np.flatnonzero(~np.array(arm.prismatic)):
        for factor, read, expected in (
            (np.pi / 180.0, "degrees", "radians"),
            (180.0 / np.pi, "radians", "degrees"),
        ):
            corrected = readings.copy()
            corrected[:, joint] *= factor
            words = f"the readings of joint {joint + 1} are {read} where the others are {expected}"
            yield JointMistake(words, corrected, arm)


def _coupled_joints(readings: Readings, arm: SerialArm) -> Iterator[JointMistake]:
    """Yield the mistakes of a joint that turns with the joint before it as well."""
    revolute = ~np.array(arm.prismatic)
    for joint in np.flatnonzero(revolute[1:] & revolute[:-1]) + 1:
        for sign, word in ((1.0, "plus"), (-1.0, "minus")):
            corrected = readings.copy()
            corrected[:, joint] += sign * readings[:, joint - 1]
            yield JointMistake(
                f"joint {joint + 1} turns by its own reading {word} the one of joint {joint}: they "
                "are coupled",
                corrected,
                arm,
            )


def joint_problem(
    readings: Readings,
    arm: SerialArm,
    camera_from_world: SE3,
    mount: str,
    used: Bool[np.ndarray, "views"],
) -> str:
    """Return which mistake in the joints explains that robot and camera move differently.

    Args:
        readings: as given.
        arm: as given.
        camera_from_world: from the pictures alone, `(views)`.
        mount: where the camera is stated to be.
        used: mask of the views to use.

    Returns:
        A sentence; empty if no mistake that is known explains it.
    """
    in_hand = mount_frames(mount)[0] == "tool"
    camera = host_matrices(camera_from_world)
    used = used & np.isfinite(camera).all(axis=(1, 2))
    possible = tuple(joint_mistakes(readings, arm))
    # One call for each description of the arm: the programs are compiled for its shapes.
    robots = np.empty((1 + len(possible), len(readings), 4, 4))
    every = [JointMistake("", readings, arm), *possible]
    for described in {id(mistake.arm): mistake.arm for mistake in every}.values():
        rows = [k for k, mistake in enumerate(every) if mistake.arm is described]
        stacked = np.stack([every[k].readings for k in rows])
        robots[rows] = host_matrices(described.base_from_tool(stacked))
    given = closure_error(motions_of_mount(robots[0], camera, used, in_hand))
    cameras = np.broadcast_to(camera, robots.shape)
    motions = motions_of_mount(robots, cameras, used, in_hand)
    errors = [ClosureError(*numbers) for numbers in closure_errors(motions).tolist()][1:]
    ranked = sorted(zip(errors, possible, strict=True), key=lambda entry: entry[0].score)
    best, _ = ranked[0]
    if best.rotation > ANGLE_TOLERANCE or best.score > MAX_CORRECTED_SCORE_RATIO * given.score:
        return ""
    named = [
        f"{mistake.description} ({closure_error_text(error, short=True)})"
        for error, mistake in ranked[:MAX_NAMED]
        if error.score <= MAX_RIVAL_SCORE_RATIO * best.score
    ]
    return (
        f"robot and camera do not move alike by these joints ({closure_error_text(given)}), but do "
        f"if {'; or if '.join(named)}"
    )
