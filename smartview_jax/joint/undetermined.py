"""Hold and report the directions of both transforms that the robot's motion does not determine.

If the robot rotates about a single axis, camera and target can be moved along this axis together
without a change of any picture. Priors on the robot's errors would still choose a position on this
line, hundreds of metres away, because with a long lever tiny rotations explain every error. The
poses alone determine these directions, so one parameter of each is held at the start: the fit does
not move along it, and all other uncertainties are for this position.

A parameter that is fixed or has a prior determines the directions that contain it.
"""

import dataclasses
from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..calibration import Calibration, host_mount_from_holder
from ..dataset import (
    Dataset,
    given_places,
    require_motion,
    turns_about_one_point,
    undetermined_twists,
)
from ..engine import TARGET_SCALE, Direction, ParameterChoice, describe_direction, step_names
from ..geometry import host_adjoints, host_matrices
from .joint_fit import JointFit

DETERMINED_PART = 1e-6
"""The smallest component of a unit direction, above rounding, that counts."""

NEGLIGIBLE_PART = float(np.sin(np.deg2rad(10.0)))
"""The component of a direction below which a parameter is not reported as undetermined.

It corresponds to ten degrees, within which an axis is also called by the letter of a coordinate.
"""


MENTIONED_PART = 5e-3
"""The component of a direction above which a parameter not called undetermined is mentioned."""


class UndeterminedMotion(NamedTuple):
    """The directions of both transforms that neither motion nor given values determine.

    Attributes:
        names: names of the twelve parameters of the two transforms.
        directions: change of these parameters along each direction.
        held: the parameters to hold at the start, one for each direction.
    """

    names: tuple[str, ...]
    directions: Float[np.ndarray, "directions 12"]
    held: tuple[str, ...]


def require_moving_robot(data: Dataset, start: Calibration, choice: ParameterChoice) -> None:
    """Raise a ValueError if the usable views' poses cannot determine a calibration.

    They are all equal; or never rotate, while neither translation is fixed or has a prior; or only
    turn about one point, while the target's size is free without a prior.
    """
    place_is_given = given_places(start.transform_names, choice.fixed, choice.priors)
    poses = host_matrices(data.base_from_tool)[data.usable_views()]
    require_motion(poses, start.transform_names[0], place_is_given)
    size_is_open = TARGET_SCALE in choice.free and TARGET_SCALE not in choice.priors
    if size_is_open and not place_is_given and turns_about_one_point(poses):
        raise ValueError(
            "the robot only turns about one point: these poses tell nothing of lengths, and "
            f"{TARGET_SCALE} is free. Move the tool by centimetres between the pictures; or state "
            "the size of the target or the tracker's unit, roughly by a Prior for "
            f"{TARGET_SCALE} with a mean"
        )


def undetermined_motion(
    data: Dataset, start: Calibration, choice: ParameterChoice
) -> UndeterminedMotion:
    """Find the directions that usable views, fixed parameters and priors do not determine.

    Args:
        data: the views to fit.
        start: the calibration at which directions are expressed.
        choice: the parameters that the user holds, frees or gives priors.
    """
    names = step_names(*start.transform_names)
    robot = host_matrices(host_mount_from_holder(data.mount, data.base_from_tool))
    robot = robot[data.usable_views()]
    empty = UndeterminedMotion(names, np.zeros((0, 12)), ())
    if len(robot) < 2 or not np.isfinite(robot).all():
        return empty
    directions = _parameter_directions(undetermined_twists(robot), robot, start)
    known = np.array([_is_selected(name, (*choice.fixed, *choice.priors)) for name in names])
    # Combinations of the directions without any change of a known parameter.
    if len(directions) and known.any():
        combinations, part, _ = np.linalg.svd(directions[:, known])
        part = np.append(part, np.zeros(len(directions) - len(part)))
        directions = combinations.T[part <= DETERMINED_PART] @ directions
    if not len(directions):
        return empty
    # The pivots of the holder's columns, or of the mount's if the holder is known.
    free = [k for k in (*range(6, 12), *range(6)) if not known[k]]
    first = [k for k in free if k >= 6] if not known[6:].all() else free
    held = _pivots(directions, first) or _pivots(directions, free)
    return UndeterminedMotion(names, directions, tuple(names[k] for k in held))


def _parameter_directions(
    twists: Float[np.ndarray, "twists 6"],
    robot: Float[np.ndarray, "views 4 4"],
    start: Calibration,
) -> Float[np.ndarray, "twists 12"]:
    """Return the change of the twelve parameters along each twist of the holder, unit vectors.

    Along a twist b the transforms are `camera_from_mount exp(a)` and `exp(b) holder_from_world`
    with `a = -Ad(T_i) b`, which is the same for every view.
    """
    if not len(twists):
        return np.zeros((0, 12))
    rotation = host_matrices(start.camera_from_mount)[:3, :3]
    place = host_matrices(start.holder_from_world)[:3, 3]
    of_mount = -twists @ host_adjoints(robot).mean(axis=0).T
    # A rotation's step multiplies it from the left, a translation's is added: see
    # `engine/parameters.py`.
    directions = np.concatenate(
        [
            of_mount[:, :3] @ rotation.T,
            of_mount[:, 3:] @ rotation.T,
            twists[:, :3] + np.cross(twists[:, 3:], place),
            twists[:, 3:],
        ],
        axis=1,
    )
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _pivots(directions: Float[np.ndarray, "directions 12"], columns: list[int]) -> list[int]:
    """Return one column for each direction that together fix all; empty if there are none."""
    if len(columns) < len(directions):
        return []
    held, remaining = [], directions.copy()
    for _ in directions:
        lengths = np.linalg.norm(remaining[:, columns], axis=0)
        if lengths.max() <= DETERMINED_PART:
            return []
        held.append(columns[int(np.argmax(lengths))])
        # Project out the direction that the new held parameter fixes.
        part = remaining[:, held[-1]] / np.linalg.norm(remaining[:, held[-1]])
        remaining = remaining - np.outer(part, part @ remaining)
    return held


def _is_selected(name: str, paths: Collection[str]) -> bool:
    """Return whether any path selects a parameter."""
    return any(name == path or name.startswith(f"{path}.") for path in paths)


def with_undetermined(fit: JointFit, motion: UndeterminedMotion) -> JointFit:
    """Return the fit with the undetermined directions reported, and infinite stds along them.

    Args:
        fit: the fit in which `motion.held` was fixed.
        motion: the directions that its data do not determine.
    """
    if not motion.held:
        return fit
    named, std, freedom = [], dict(fit.std), dict(fit.degrees_of_freedom)
    for direction, held in zip(_sparse(motion), motion.held, strict=True):
        largest = np.abs(direction).max()
        order = [int(k) for k in np.argsort(-np.abs(direction))]
        parts = [k for k in order if abs(direction[k]) > NEGLIGIBLE_PART * largest]
        components = tuple((motion.names[k], float(direction[k])) for k in parts)
        for name, _ in components:
            if name in std or name == held:
                std[name] = freedom[name] = np.inf
        text = describe_direction(components, fit.calibration)
        named.append(Direction(0.0, components, text + _small_parts(motion.names, direction)))
    observability = fit.observability._replace(
        parameter_count=fit.observability.parameter_count + len(named),
        null_directions=(*named, *fit.observability.null_directions),
        smallest_singular_value=0.0,
    )
    return dataclasses.replace(
        fit, std=std, degrees_of_freedom=freedom, observability=observability
    )


def _sparse(motion: UndeterminedMotion) -> Float[np.ndarray, "directions 12"]:
    """Return combinations of the directions that each move a single held parameter."""
    held = [motion.names.index(name) for name in motion.held]
    directions = np.linalg.solve(motion.directions[:, held], motion.directions)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _small_parts(names: tuple[str, ...], direction: Float[np.ndarray, "12"]) -> str:
    """Return in words which other parameters change a little along a direction.

    Their intervals are for the held value of the direction.
    """
    largest = int(np.argmax(np.abs(direction)))
    part = names[largest].split(".")[1]
    shares = {
        name: share
        for name, share in zip(names, direction / direction[largest], strict=True)
        if f".{part}." in name and MENTIONED_PART < abs(share) <= NEGLIGIBLE_PART
    }
    if not shares:
        return ""
    unit = "mm" if part == "translation" else "degree"
    listed = ", ".join(f"{name} changes by {share:+.3f}" for name, share in shares.items())
    return f" (for each {unit} of {names[largest]}, {listed})"
