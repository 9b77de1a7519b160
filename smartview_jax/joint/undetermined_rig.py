"""Find the directions of a rig's transforms that the robots' motions do not determine.

Several cameras move together along such a direction, with the target that they see; where an arm's
motion does not tell where its target is, it does not tell either where the arm's base is to others.
"""

from collections.abc import Mapping

import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..calibration import Calibration
from ..dataset import Rig, arms_of, reported_poses
from ..engine import ParameterChoice, base_path, parameter_names, rig_parameter_names, step_names
from ..geometry import host_adjoints, host_matrices
from .undetermined_motion import (
    MovablePose,
    Sight,
    UndeterminedMotion,
    find_undetermined_motion,
)

_Matrices = Float[np.ndarray, "*poses 4 4"]


def undetermined_motion_of_rig(
    rig: Rig,
    calibrations: Mapping[str, Calibration],
    choice: ParameterChoice,
    bases: Mapping[str, SE3],
    held_first: str = "poses",
) -> UndeterminedMotion:
    """Find the directions that usable views, fixed parameters and priors do not determine.

    Args:
        rig: data sets of the cameras.
        calibrations: calibration of each camera, at which directions are expressed.
        choice: the parameters that the user holds, frees or gives priors.
        bases: transform from each arm's base to the base of the first; empty for one arm.
        held_first: as in `find_undetermined_motion`.
    """
    robots = rig.robot_names
    places = {robots[0]: np.eye(4)} | {arm: host_matrices(base) for arm, base in bases.items()}
    poses = {
        path: MovablePose(step_names(path), places[arm])
        for arm in robots[1:]
        for path in [base_path(robots[0], arm)]
    }
    names, sights = rig_parameter_names(rig, calibrations), []
    for camera, data in rig.cameras.items():
        calibration, views = calibrations[camera], data.usable_views()
        if not len(views) or not np.isfinite(host_matrices(data.base_from_tool)[views]).all():
            continue
        in_rig = dict(zip(parameter_names(calibration), names[camera], strict=True))
        mount, holder = (
            tuple(in_rig[name] for name in step_names(path)) for path in calibration.transform_names
        )
        path = holder[0].removesuffix(".translation.x")
        place = host_matrices(calibration.holder_from_world)
        if calibration.mount == "eye_in_hand":
            place = places[rig.arms[camera]] @ place
        poses.setdefault(path, MovablePose(holder, place))
        motions = _motions_of_mount(rig, camera, path, places)
        sights.append(
            Sight(
                MovablePose(mount, host_matrices(calibration.camera_from_mount)),
                {pose: effects[views] for pose, effects in motions.items()},
            )
        )
    if not any(len(effects) > 1 for sight in sights for effects in sight.motions.values()):
        return UndeterminedMotion((), np.zeros((0, 0)), ())
    return find_undetermined_motion(sights, poses, choice, held_first)


def _motions_of_mount(
    rig: Rig, camera: str, holder: str, places: Mapping[str, _Matrices]
) -> dict[str, Float[np.ndarray, "views 6 6"]]:
    """Return the effect on a camera's mount of the motions of its target's pose and of the bases.

    Args:
        rig: data sets of the cameras.
        camera: the camera's name.
        holder: path of its target's pose.
        places: pose of each arm's base in the base of the first.
    """
    data, arm = rig.cameras[camera], rig.arms[camera]
    reported = reported_poses(data)
    if data.mount == "eye_to_hand":
        return {holder: host_adjoints(reported[0])}
    # With `from_reference` the frame of the mount from the base of the first arm: a motion of the
    # target's pose in that base, or of a base of the target's arm, moves the picture as the same
    # motion of all that is seen; a motion of the base of the camera's arm as the opposite one.
    first, *others = arms_of(arm)
    from_reference = np.linalg.inv(places[first] @ reported[0])
    effects = host_adjoints(from_reference)
    motions = {holder: effects}
    if others:
        (other,) = others
        motions = {holder: host_adjoints(from_reference @ places[other] @ reported[1])}
        motions[base_path(rig.robot_names[0], other)] = effects
    motions[base_path(rig.robot_names[0], first)] = -effects
    # The base of the first arm is the reference and does not move.
    motions.pop(base_path(rig.robot_names[0], rig.robot_names[0]), None)
    return motions
