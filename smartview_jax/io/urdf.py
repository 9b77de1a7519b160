"""Read an arm from a URDF file: the chain between two links, as Denavit-Hartenberg parameters.

The conversion is exact: the parameters describe the same joint axes in space. Only joints are read;
shapes and meshes are ignored. The optional `urdf-parser-py` is needed:
`pip install smartview-jax[urdf]`.
"""

import contextlib
import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..argument_checks import shortened_repr
from ..extras import import_extra
from ..files import read_text
from ..geometry import host_poses
from ..robots import SerialArm, arm_from_axes

MAX_MAGNITUDE = 100.0
"""Largest magnitude of an offset (m), an angle (rad) or a component of an axis."""

_MOVABLE_JOINT_TYPES = ("revolute", "continuous", "prismatic")


def load_urdf(path: str | Path, base: str | None = None, tip: str | None = None) -> SerialArm:
    """Read the arm between two links of a URDF file.

    Args:
        path: of the file; xacro files have to be expanded first.
        base: name of the link that is the base frame of the poses; by default the root.
        tip: name of the link that is the tool; by default the last one, if there is only one.

    Raises:
        ValueError: not a URDF file; no chain between the links; several last links and no `tip`; a
            joint that is floating or planar or mimics another. The message names the joint.
        FileNotFoundError: the file is missing.
        ImportError: `urdf-parser-py` is not installed.
    """
    path = Path(path)
    chain = _read_chain(path, base, tip)
    # At zero readings joints add no motion, so the product of the origins is the pose of the
    # joint's frame in the base. The joint axis passes through the origin of this frame.
    pose, points, directions, prismatic, limits = np.eye(4), [], [], [], []
    for joint in chain:
        pose = pose @ _origin(joint, path)
        if joint.type == "fixed":
            continue
        if joint.type not in _MOVABLE_JOINT_TYPES:
            raise ValueError(
                f"{path}: joint {joint.name} is {joint.type}; an arm's are revolute or prismatic"
            )
        if joint.mimic is not None:
            raise ValueError(f"{path}: joint {joint.name} mimics {joint.mimic.joint}")
        # The URDF format defines x as the axis of a joint that states none.
        axis = (1.0, 0.0, 0.0) if joint.axis is None else joint.axis
        points.append(pose[:3, 3])
        directions.append(pose[:3, :3] @ _parse_vector(axis, joint, "axis", path))
        prismatic.append(joint.type == "prismatic")
        limits.append(_limits(joint, path))
    if not points:
        raise ValueError(f"{path}: no joint moves between the base and the tip")
    try:
        return arm_from_axes(
            np.stack(points), np.stack(directions), pose, prismatic, np.array(limits, dtype=float)
        )
    except ValueError as error:
        names = ", ".join(joint.name for joint in chain if joint.type != "fixed")
        raise ValueError(f"{path}: joints {names}: {error}") from error


def urdf_joint_names(
    path: str | Path, base: str | None = None, tip: str | None = None
) -> tuple[str, ...]:
    """Return the names of the joints that move, in the order of `load_urdf`'s arm.

    Args:
        path, base, tip: as in `load_urdf`.

    Raises:
        ValueError: as `load_urdf`.
    """
    chain = _read_chain(Path(path), base, tip)
    return tuple(joint.name for joint in chain if joint.type != "fixed")


def _read_chain(path: Path, base: str | None, tip: str | None) -> list[Any]:
    """Return the joints between two links of a file, in order."""
    text = read_text(path)
    # Nested entities can expand a small file to one that fills the memory.
    if "<!ENTITY" in text:
        raise ValueError(f"{path}: entity declarations are not accepted")
    return _joint_chain(_parse_urdf(text.encode("utf-8"), path), base, tip, path)


def _parse_urdf(content: bytes, path: Path) -> Any:
    urdf = import_extra("urdf_parser_py.urdf", "urdf", "reading URDF")
    # The parser prints every unknown tag, such as a simulator's.
    with open(os.devnull, "w") as devnull, contextlib.redirect_stderr(devnull):
        # The parser raises errors of many unrelated types for a malformed file.
        try:
            return urdf.URDF.from_xml_string(content)
        except Exception as error:
            raise ValueError(f"{path}: not a URDF file: {error}") from error


def _joint_chain(robot: Any, base: str | None, tip: str | None, path: Path) -> list[Any]:
    """Return the joints from the base link to the tip link, in order."""
    # Links are the nodes of a tree and joints its edges: a root is no joint's child, and a leaf is
    # no joint's parent.
    links = {link.name for link in robot.links}
    joint_by_child = {joint.child: joint for joint in robot.joints}
    roots = sorted(links - set(joint_by_child))
    leaves = sorted(links - {joint.parent for joint in robot.joints})
    for name, link in (("base", base), ("tip", tip)):
        if link is not None and link not in links:
            raise ValueError(f"{path}: {name}={link!r}: no such link")
    if base is None and len(roots) != 1:
        raise ValueError(f"{path}: {len(roots)} root links: give base=, one of {roots}")
    base_link = roots[0] if base is None else base
    if tip is None:
        leaves = [
            end for end in leaves if _joints_between(joint_by_child, base_link, end) is not None
        ]
        if len(leaves) != 1:
            raise ValueError(f"{path}: the chain branches: give tip=, such as one of {leaves}")
    tip_link = leaves[0] if tip is None else tip
    chain = _joints_between(joint_by_child, base_link, tip_link)
    if chain is None:
        raise ValueError(f"{path}: no chain from link {base_link} to link {tip_link}")
    return chain


def _joints_between(joint_by_child: dict[str, Any], base: str, tip: str) -> list[Any] | None:
    """Return the joints between two links, in order; None if the tip is not below the base."""
    chain, link = [], tip
    while link != base:
        # A chain longer than the number of joints is a cycle of a malformed file.
        if link not in joint_by_child or len(chain) > len(joint_by_child):
            return None
        chain.append(joint_by_child[link])
        link = joint_by_child[link].parent
    return chain[::-1]


def _origin(joint: Any, path: Path) -> Float[np.ndarray, "4 4"]:
    """Return the pose of a joint's frame in the frame of its parent link, m."""
    if joint.origin is None:
        return np.eye(4)
    zeros = (0.0, 0.0, 0.0)
    # rpy about fixed axes is R = Rz(yaw) Ry(pitch) Rx(roll): yaw, pitch, roll in reverse order.
    angles = _parse_vector(joint.origin.rpy or zeros, joint, "origin rpy", path)[::-1]
    position = _parse_vector(joint.origin.xyz or zeros, joint, "origin xyz", path)
    return host_poses(Rotation.from_euler("ZYX", angles).as_matrix(), position)


def _parse_vector(values: Any, joint: Any, label: str, path: Path) -> np.ndarray:
    """Return three numbers, m or rad; raise a ValueError for one over `MAX_MAGNITUDE`."""
    try:
        numbers = np.array([float(value) for value in values])
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    # Written as "not all within the limit" so that NaN, for which every comparison is false, fails.
    if numbers.shape != (3,) or not (np.abs(numbers) <= MAX_MAGNITUDE).all():
        raise ValueError(
            f"{path}: joint {joint.name}: {label}: expected three numbers from "
            f"-{MAX_MAGNITUDE:g} to {MAX_MAGNITUDE:g}, found {shortened_repr(values)}"
        )
    return numbers


def _limits(joint: Any, path: Path) -> tuple[float, float]:
    """Return the lower and upper limit of a joint, rad or m; infinite where it has none."""
    if joint.type == "continuous" or joint.limit is None:
        return -np.inf, np.inf
    # The URDF format defines a bound that is not stated as zero.
    lower, upper = (float(bound or 0.0) for bound in (joint.limit.lower, joint.limit.upper))
    if not -np.inf < lower < upper < np.inf:
        raise ValueError(f"{path}: joint {joint.name}: limits: {lower} is not below {upper}")
    return lower, upper
