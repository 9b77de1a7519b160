"""Compute the arm's motions through the poses of grasps, and check that it can make them."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..geometry import host_matrices, host_transformed
from ..robots import Gripper
from ..viewpoints import ViewpointCommands
from .collisions import CollisionChecker, Contact, swept_links
from .planned import PHASES
from .scene import GraspScene
from .tool_commands import MOTION_CHECKS, gripper_commands

MAX_JOINT_STEP = float(np.deg2rad(60.0))
"""Largest motion of a joint between two poses of a grasp, rad.

They are centimetres apart: if the wrist turns over in between, the tool leaves the straight line.
"""

LINK_STEPS = 4
"""Number of steps in which the links of the arm are swept between two poses of a grasp."""


class Motions(NamedTuple):
    """The commands of several grasps, with the reasons against them.

    Attributes:
        base_from_tool: a command for each phase of each grasp, m; NaN where there is none.
        joints: the same as joint readings, rad or m; None without an arm.
        reasons: why the arm cannot execute each grasp; empty if it can.
    """

    base_from_tool: Float[np.ndarray, "grasps phases 4 4"]
    joints: Float[np.ndarray, "grasps phases joints"] | None
    reasons: tuple[tuple[str, ...], ...]


def plan_motions(
    scene: GraspScene, gripper: Gripper, world_from_gripper: Float[np.ndarray, "grasps phases 4 4"]
) -> Motions:
    """Return the commands for the poses of grasps, with reach, limits and singularity checked."""
    count, phases = world_from_gripper.shape[:2]
    first = gripper_commands(scene, gripper, world_from_gripper[:, 0])
    # The later poses are solved near the first one's joints, in the same configuration of the arm.
    near = None
    if first.joints is not None:
        near = np.repeat(np.nan_to_num(np.asarray(first.joints)[:count]), phases - 1, axis=0)
    later = gripper_commands(scene, gripper, world_from_gripper[:, 1:].reshape(-1, 4, 4), near)
    base_from_tool, joints = _joined(first, later, count)
    # The commands of the later phases follow one another, grasp by grasp.
    after = phases - 1
    reasons = [
        _check_reasons(first, slice(k, k + 1), PHASES[:1])
        + _check_reasons(later, slice(after * k, after * (k + 1)), PHASES[1:])
        for k in range(count)
    ]
    if joints is not None:
        links = CollisionChecker(scene.obstacles if scene.link_radius is not None else ())
        for k in range(count):
            if not reasons[k]:
                reasons[k] += _joint_reasons(scene, joints[k], links)
    return Motions(base_from_tool, joints, tuple(tuple(texts) for texts in reasons))


def _joined(
    first: ViewpointCommands, later: ViewpointCommands, count: int
) -> tuple[
    Float[np.ndarray, "grasps phases 4 4"], Float[np.ndarray, "grasps phases joints"] | None
]:
    """Return the commands of the first phase and of the later ones, grasp by grasp."""
    after = len(PHASES) - 1

    def join(start: np.ndarray, others: np.ndarray) -> np.ndarray:
        # Cut off the padding.
        others = others[: after * count].reshape(count, after, *others.shape[1:])
        return np.concatenate([start[:count, None], others], axis=1)

    poses = join(host_matrices(first.base_from_tool), host_matrices(later.base_from_tool))
    if first.joints is None or later.joints is None:
        return poses, None
    return poses, join(np.asarray(first.joints), np.asarray(later.joints))


def _check_reasons(commands: ViewpointCommands, which: slice, phases: tuple[str, ...]) -> list[str]:
    """Return the reasons of the failed checks, each once, with the phases that fail it."""
    failed: dict[str, list[str]] = {}
    for phase, text in zip(phases, commands.checks.reasons(MOTION_CHECKS)[which], strict=True):
        if text:
            failed.setdefault(text, []).append(phase)
    return [f"{text} ({', '.join(names)})" for text, names in failed.items()]


def _joint_reasons(
    scene: GraspScene, joints: Float[np.ndarray, "phases joints"], links: CollisionChecker
) -> list[str]:
    """Return reasons against joint readings although they reach all poses."""
    assert scene.arm is not None
    reasons = []
    # Sliding joints are in metres and do not turn.
    turns = np.where(scene.arm.prismatic, 0.0, np.abs(np.diff(joints, axis=0)))
    if turns.max() > MAX_JOINT_STEP:
        step, joint = np.unravel_index(int(np.argmax(turns)), turns.shape)
        reasons.append(
            f"joint {1 + joint} turns by {np.rad2deg(turns.max()):.0f} degrees between "
            f"{PHASES[step]} and {PHASES[step + 1]}"
        )
    if scene.link_radius is not None:
        for k, way in enumerate(pairwise(joints)):
            contact = _link_contact(scene, np.array(way), links)
            if contact is not None:
                reasons.append(f"{contact} ({PHASES[k]} to {PHASES[k + 1]})")
    return reasons


def _link_contact(
    scene: GraspScene, joints: Float[np.ndarray, "2 joints"], links: CollisionChecker
) -> Contact | None:
    """Return where the arm's links come too close to an obstacle between two joint readings.

    The joints are assumed to turn evenly. This takes the tool off its straight line by less than
    3 mm if they turn by 10 degrees, as in a usual retreat of 0.12 m, and the links by less.
    """
    assert scene.arm is not None
    assert scene.link_radius is not None
    shares = np.linspace(0.0, 1.0, LINK_STEPS + 1)[:, None]
    origins = np.asarray(scene.arm.frame_origins(joints[0] + shares * (joints[1] - joints[0])))
    world_from_base = np.linalg.inv(host_matrices(scene.calibration.base_from_world))
    in_world = host_transformed(world_from_base, origins)
    # The first link is the arm's fixed column.
    for parts in swept_links(in_world[:, 1:], scene.link_radius):
        contact = links.nearest(parts, within=scene.margin)
        if contact is not None:
            return contact
    return None
