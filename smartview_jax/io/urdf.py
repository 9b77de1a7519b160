"""Arms from URDF files: the chain between two links, as Denavit-Hartenberg numbers.

Exact: the numbers describe the same lines in space, whatever frames the file hangs on them. Only
joints are read; shapes and meshes are not looked for. Needs the optional `urdf-parser-py`:
`pip install smartview-jax[urdf]`.
"""

import contextlib
import os
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..files import read_text
from ..geometry import rotation_from_ypr
from ..robots import SerialArm, arm_from_axes
from ..schemas.words import shown

LARGEST = 100.0
"""Of an offset (m) or an angle (rad)."""

_MOVING = ("revolute", "continuous", "prismatic")


def load_urdf(path: str | Path, base: str | None = None, tip: str | None = None) -> SerialArm:
    """The arm between two links of a URDF file.

    Args:
        path: of the file; xacro files have to be expanded first.
        base: link that poses are in; by default the root.
        tip: link that is the tool; by default the one at the end, if there is only one.

    Raises:
        ValueError: not a URDF file; no chain between the links; several ends and no `tip`; a joint
            that floats, moves in a plane or mimics another. The message names it.
        FileNotFoundError: the file is missing.
        ImportError: the library that parses it is not installed.
    """
    path = Path(path)
    text = read_text(path)
    if "<!ENTITY" in text:
        raise ValueError(f"{path}: entity declarations are not accepted")
    robot = _parsed(text.encode("utf-8"), path)
    chain = _chain(robot, base, tip, path)
    pose, points, directions, slides, limits = np.eye(4), [], [], [], []
    for joint in chain:
        pose = pose @ _origin(joint, path)
        if joint.type == "fixed":
            continue
        if joint.type not in _MOVING:
            raise ValueError(f"{path}: joint {joint.name} is {joint.type}; an arm's turn or slide")
        if joint.mimic is not None:
            raise ValueError(f"{path}: joint {joint.name} mimics {joint.mimic.joint}")
        # Without one the axis is x, by the format's definition.
        axis = (1.0, 0.0, 0.0) if joint.axis is None else joint.axis
        points.append(pose[:3, 3])
        directions.append(pose[:3, :3] @ _vector(axis, joint, "axis", path))
        slides.append(joint.type == "prismatic")
        limits.append(_limits(joint, path))
    if not points:
        raise ValueError(f"{path}: no joint moves between the base and the tip")
    try:
        return arm_from_axes(
            np.stack(points), np.stack(directions), pose, slides, np.array(limits, dtype=float)
        )
    except ValueError as error:
        names = ", ".join(joint.name for joint in chain if joint.type != "fixed")
        raise ValueError(f"{path}: joints {names}: {error}") from error


def _parsed(content: bytes, path: Path) -> Any:
    try:
        from urdf_parser_py.urdf import URDF  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError("reading URDF needs urdf-parser-py: smartview-jax[urdf]") from error
    # It prints what it does not know, such as the tags of simulators.
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stderr(nowhere):
        try:
            return URDF.from_xml_string(content)
        except Exception as error:
            raise ValueError(f"{path}: not a URDF file: {error}") from error


def _chain(robot: Any, base: str | None, tip: str | None, path: Path) -> list[Any]:
    """Joints from base to tip."""
    links = {link.name for link in robot.links}
    above = {joint.child: joint for joint in robot.joints}
    roots, ends = sorted(links - set(above)), sorted(links - {j.parent for j in robot.joints})
    for name, link in (("base", base), ("tip", tip)):
        if link is not None and link not in links:
            raise ValueError(f"{path}: no link is called {link!r}, as {name}")
    if base is None and len(roots) != 1:
        raise ValueError(f"{path}: not one root but {len(roots)}: give base=, one of {roots}")
    first = roots[0] if base is None else base
    if tip is None:
        ends = [end for end in ends if _path(above, first, end) is not None]
        if len(ends) != 1:
            raise ValueError(f"{path}: the chain branches: give tip=, such as one of {ends}")
    last = ends[0] if tip is None else tip
    found = _path(above, first, last)
    if found is None:
        raise ValueError(f"{path}: link {last} does not hang on link {first}")
    return found


def _path(above: dict[str, Any], base: str, tip: str) -> list[Any] | None:
    chain, link = [], tip
    while link != base:
        # Longer than all joints together is round in a circle.
        if link not in above or len(chain) > len(above):
            return None
        chain.append(above[link])
        link = above[link].parent
    return chain[::-1]


def _origin(joint: Any, path: Path) -> Float[np.ndarray, "4 4"]:
    pose = np.eye(4)
    if joint.origin is not None:
        nothing = (0.0, 0.0, 0.0)
        angles = _vector(joint.origin.rpy or nothing, joint, "origin rpy", path)[::-1]
        pose[:3, :3] = np.asarray(rotation_from_ypr(jnp.asarray(angles)).as_matrix())
        pose[:3, 3] = _vector(joint.origin.xyz or nothing, joint, "origin xyz", path)
    return pose


def _vector(values: Any, joint: Any, what: str, path: Path) -> np.ndarray:
    """Return three numbers, m or rad, each within 100."""
    try:
        numbers = np.array([float(value) for value in values])
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    # NaN is not below anything.
    if numbers.shape != (3,) or not (np.abs(numbers) <= LARGEST).all():
        raise ValueError(
            f"{path}: joint {joint.name}: {what}: expected three numbers from -{LARGEST:g} to "
            f"{LARGEST:g}, found {shown(values)}"
        )
    return numbers


def _limits(joint: Any, path: Path) -> tuple[float, float]:
    if joint.type == "continuous" or joint.limit is None:
        return -np.inf, np.inf
    # A limit that is not given is zero, by the format's definition.
    lower, upper = (float(bound or 0.0) for bound in (joint.limit.lower, joint.limit.upper))
    if not -np.inf < lower < upper < np.inf:
        raise ValueError(f"{path}: joint {joint.name}: limits: {lower} is not below {upper}")
    return lower, upper
