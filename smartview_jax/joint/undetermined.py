"""Hold and report the directions of both transforms that the robot's motion does not determine.

If the robot rotates about a single axis, camera and target can be moved along this axis together
without a change of any picture. Priors on the robot's errors would still choose a position on this
line, hundreds of metres away, because with a long lever tiny rotations explain every error. The
poses alone determine these directions, so one parameter of each is held at the start: the fit does
not move along it, and all other uncertainties are for this position.

A parameter that is fixed or has a prior determines the directions that contain it.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from ..calibration import Calibration
from ..dataset import Dataset, given_places, require_motion, turns_about_one_point
from ..engine import TARGET_SCALE, Direction, ParameterChoice, describe_direction, step_names
from ..geometry import host_adjoints, host_matrices
from .joint_fit import JointFit
from .undetermined_motion import (
    NEGLIGIBLE_PART,
    MovablePose,
    Sight,
    UndeterminedMotion,
    find_undetermined_motion,
    large_parts,
)

MENTIONED_PART = 5e-3
"""The component of a direction above which a parameter not called undetermined is mentioned."""


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
    mount_path, holder_path = start.transform_names
    mount = MovablePose(step_names(mount_path), host_matrices(start.camera_from_mount))
    holder = MovablePose(step_names(holder_path), host_matrices(start.holder_from_world))
    robot = host_matrices(data.mount_from_holder)
    robot = robot[data.usable_views()]
    if len(robot) < 2 or not np.isfinite(robot).all():
        return UndeterminedMotion((*mount.names, *holder.names), np.zeros((0, 12)), ())
    sight = Sight(mount, {holder_path: host_adjoints(robot)})
    return find_undetermined_motion([sight], {holder_path: holder}, choice)


def with_undetermined(fit: JointFit, motion: UndeterminedMotion) -> JointFit:
    """Return the fit with the undetermined directions reported, and infinite stds along them.

    Args:
        fit: the fit in which `motion.held` was fixed.
        motion: the directions that its data do not determine.
    """
    if not motion.held:
        return fit
    named, std, freedom = [], dict(fit.std), dict(fit.degrees_of_freedom)
    for direction, held in zip(motion.of_held, motion.held, strict=True):
        components = tuple((motion.names[k], float(direction[k])) for k in large_parts(direction))
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
