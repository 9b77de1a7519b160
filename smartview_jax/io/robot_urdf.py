"""Write a calibrated arm with its camera as a URDF file for other programs.

The joint zeros, link lengths and twists that were found are part of the chain, so that any
program's forward kinematics gives the actual pose of the tool for the controller's joint readings.
Only the kinematics is written: no shapes and no masses. Joints are rigid in a URDF: bending under
the arm's weight is left out where it is small (`MAX_BENDING`), and refused elsewhere.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..calibration import Calibration
from ..export_text import checked_frame_name, origin_text, pose_matrix
from ..geometry import host_matrices
from ..robot_errors import AbstractArmErrors, DHErrors, ElasticDHErrors, RobotError
from ..robots import SerialArm
from .export import mount_from_camera
from .urdf import MAX_MAGNITUDE

BASE_LINK = "base_link"
"""Name of the link of the base frame."""

MAX_BENDING = 1e-4
"""Largest displacement of the tool by joints that bend under the arm's weight (RMS over the arm's
poses, m) up to which a URDF leaves the bending out; good arms repeat a pose about as well.

A calibration averages over models: in it even the joints of a rigid arm bend a little.
"""


def robot_urdf(
    calibration: Calibration,
    arm: SerialArm | None = None,
    tool: str = "tool0",
    camera: str = "camera_optical_frame",
    joint_names: Sequence[str] | None = None,
) -> str:
    """Return a URDF robot: the calibrated arm from `base_link` to the tool, and the camera.

    The camera's frame is the optical frame, fixed to the tool, or to the base for a fixed camera.

    Args:
        calibration: a calibration that corrects an arm's joints and links, or no robot error.
        arm: the arm of a calibration without robot error, which does not know it.
        joint_names: name of each joint, in the arm's order; by default joint_1, joint_2, ...

    Raises:
        ValueError: no arm is known, the robot error is of a kind that no URDF has, or a name is
            wrong.
    """
    actual = actual_arm(calibration, arm)
    count = actual.joint_count
    joints = [f"joint_{1 + k}" for k in range(count)] if joint_names is None else [*joint_names]
    if len(joints) != count:
        raise ValueError(f"joint_names: expected {count} names, found {len(joints)}")
    links = [BASE_LINK, *(f"link_{1 + k}" for k in range(count)), tool, camera]
    names = [*joints, *links]
    for name in names:
        checked_frame_name(name)
    if len(set(links)) < len(links) or len(set(joints)) < len(joints):
        raise ValueError(f"names: expected different ones, found {', '.join(names)}")
    origins = joint_origins(actual)
    lines = ['<?xml version="1.0"?>', '<robot name="calibrated_arm">']
    lines += [f'  <link name="{link}"/>' for link in links]
    for k, joint in enumerate(joints):
        limits = np.asarray(actual.limits)[k]
        lines += _joint(
            joint, links[k], links[1 + k], origins[k], _motion(actual.prismatic[k], limits)
        )
    lines += _joint(f"{tool}_fixed", links[count], tool, origins[count])
    mount = BASE_LINK if calibration.mount == "eye_to_hand" else tool
    camera_pose = pose_matrix(mount_from_camera(calibration))
    lines += _joint(f"{camera}_fixed", mount, camera, camera_pose)
    return "\n".join([*lines, "</robot>"]) + "\n"


def actual_arm(calibration: Calibration, arm: SerialArm | None = None) -> SerialArm:
    """Return the arm with the zeros, lengths and twists that were found, or the given arm.

    Joints that displace the tool by at most `MAX_BENDING` as they bend are taken as rigid.
    """
    error = calibration.robot_error
    if error is None:
        if arm is None:
            raise ValueError(
                "arm: missing; the calibration knows no arm: name it, or calibrate with the "
                "readings of its joints"
            )
        return arm
    error = error.whole
    field = error.field
    if not isinstance(field, AbstractArmErrors):
        raise ValueError(
            f"the robot's error, {type(field).__name__}, is not of joints and links, and no URDF "
            "has it: calibrate with joint readings, or export the calibration that was fitted "
            "without the correction"
        )
    if not np.all(np.asarray(field.joint_scale_factors(error.coefficients)) == 1.0):
        raise ValueError("gear ratios were found (joint_ratio), and no URDF has them")
    if isinstance(field, ElasticDHErrors):
        bending = _bending(error, field.arm)
        if not bending <= MAX_BENDING:
            raise ValueError(
                "joints were found to bend under the arm's weight (joint_compliance), by "
                f"{1e3 * bending:.2g} mm at the tool, and no URDF has this: calibrate with "
                "field=sv.robot_errors.DHErrors(arm) for a rigid arm"
            )
    return field.actual_arm(error.coefficients)


def _bending(error: RobotError, arm: SerialArm) -> float:
    """Return by how far bending joints displace the tool, m: RMS over poses within the limits."""
    lower, upper = np.clip(np.asarray(arm.limits), -np.pi, np.pi).T
    joints = np.random.default_rng(0).uniform(lower, upper, (100, arm.joint_count))
    command = arm.command(joints)
    rigid = error.converted_to(DHErrors(arm)).converted_to(error.field)
    bent, straight = (host_matrices(x.actual_pose(command))[:, :3, 3] for x in (error, rigid))
    return float(np.sqrt(np.mean(np.sum((bent - straight) ** 2, axis=1))))


def joint_origins(arm: SerialArm) -> Float[np.ndarray, "frames 4 4"]:
    """Return the frame of each joint in the one before it, and the tool in the last joint's.

    Each joint turns about, or slides along, the z axis of its frame.
    """
    numbers = (np.asarray(row) for row in (arm.theta, arm.d, arm.a, arm.alpha))
    # A reading turns about z or slides along z, and so it commutes with theta and d: all of a
    # link's transform can stand behind its joint (standard), or before it (modified).
    screws = [
        (_screw("z", theta, d), _screw("x", alpha, a))
        for theta, d, a, alpha in zip(*numbers, strict=True)
    ]
    first, tool = host_matrices(arm.base_from_first), host_matrices(arm.flange_from_tool)
    if arm.convention == "standard":
        behind = [joint @ link for joint, link in screws]
        return np.stack([first, *behind[:-1], behind[-1] @ tool])
    before = [link @ joint for joint, link in screws]
    return np.stack([first @ before[0], *before[1:], tool])


def _screw(axis: str, angle: float, distance: float) -> Float[np.ndarray, "4 4"]:
    """Return a rotation about a coordinate axis with a translation along it."""
    screw = np.eye(4)
    screw[:3, :3] = Rotation.from_euler(axis, angle).as_matrix()
    screw["xyz".index(axis), 3] = distance
    return screw


def _motion(prismatic: bool, limits: Float[np.ndarray, "2"]) -> tuple[str, list[str]]:
    """Return the type of a moving joint, and the lines on its axis and its limits."""
    lines = ['    <axis xyz="0 0 1"/>']
    bounded = bool(np.isfinite(limits).all())
    if not prismatic and not bounded:
        return "continuous", lines
    # A sliding joint has to state limits.
    lower, upper = np.clip(limits, -MAX_MAGNITUDE, MAX_MAGNITUDE) if prismatic else limits
    # Effort and velocity have to be stated too, and are not known.
    bounds = f'lower="{float(lower)!r}" upper="{float(upper)!r}" effort="0" velocity="0"'
    return "prismatic" if prismatic else "revolute", [*lines, f"    <limit {bounds}/>"]


def _joint(
    name: str,
    parent: str,
    child: str,
    origin: Float[np.ndarray, "4 4"],
    motion: tuple[str, list[str]] = ("fixed", []),
) -> list[str]:
    kind, lines = motion
    return [
        f'  <joint name="{name}" type="{kind}">',
        f'    <parent link="{parent}"/>',
        f'    <child link="{child}"/>',
        f"    {origin_text(origin)}",
        *lines,
        "  </joint>",
    ]
