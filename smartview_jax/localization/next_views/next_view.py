"""Choose the most informative view of the objects found, among the views the robot can reach.

The paper's view looks along the normal of the localised top surface. It is reported together with
the view of the largest expected gain (`view_gains`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...argument_checks import MAX_COORDINATE, require_instance
from ...calibration import Calibration
from ...engine import Noise
from ...geometry import check_rigid, host_matrices, host_transformed, look_at, spiral_directions
from ...modeling import ObjectModel, face_plane
from ...robots import JointsLike, SerialArm
from ...viewpoints import Limits, viewpoint_commands
from ..edges import checked_triangles
from ..judging import Localization
from .view_gains import ViewGains

OF_ONE_CAMERA = "of a rig, give the camera that takes the view, such as fit.calibrations['left']"
"""The hint where the calibrations of several cameras are given."""

DIRECTIONS = 64
"""Number of default view directions, spread over a hemisphere."""

LOWEST_ELEVATION = float(np.deg2rad(25.0))
"""Smallest angle of these directions from the horizontal, rad."""


class Reachable(NamedTuple):
    """The views from which the next one is chosen.

    Attributes:
        camera_from_world: candidates, `(n, 4, 4)`, or one, `(4, 4)`; None for directions over the
            object, at `distance`.
        distance: distance from the camera to the object, m; required without candidates. The
            paper's view is at this distance or, by default, at the candidates' median depth.
        arm: the arm, with `near`; None where every pose within the limits is reachable.
        near: joint readings near which the arm takes its views.
        limits: limits of the viewpoints, as in `viewpoint_commands`.
    """

    camera_from_world: Float[np.ndarray, "*n 4 4"] | None = None
    distance: float | None = None
    arm: SerialArm | None = None
    near: JointsLike | None = None
    limits: Limits | None = None


class NextView(NamedTuple):
    """A view to take next, with the expected gain.

    Attributes:
        base_from_tool: command for the robot.
        camera_from_world: the camera's pose there.
        joints: joint readings of the command; None without an arm.
        discrimination: expected log-likelihood ratio of the objects to their rivals.
        position_std: largest position error of the objects' middles (std) before and after the
            view, m.
        gain: total of both gains, in nats.
        reason: the reason in words, a clause without a capital letter.
        paper: the paper's view, along the normal of the top surface; None where the robot does not
            reach it, and in the paper's view itself.
    """

    base_from_tool: Float[np.ndarray, "4 4"]
    camera_from_world: Float[np.ndarray, "4 4"]
    joints: Float[np.ndarray, "joints"] | None
    discrimination: float
    position_std: tuple[float, float]
    gain: float
    reason: str
    paper: "NextView | None"


def next_view(
    localizations: Sequence[Localization],
    calibration: Calibration,
    reachable: Reachable,
    *,
    noise: Noise | None = None,
    models: Sequence[ObjectModel] = (),
    neighbours: Sequence[Localization] = (),
    occluders: Float[np.ndarray, "triangles 3 3"] | None = None,
) -> NextView:
    """Return the reachable view that best separates rival hypotheses and reduces pose errors.

    Args:
        localizations: results of `localize`, in the world frame of the calibration; rejected ones
            are ignored.
        calibration: of the camera that takes the next view; of a rig, `fit.calibrations["left"]`.
        reachable: the views that the robot may take.
        noise: of the robot, whose error limits the information of the new view; None for an exact
            robot.
        models: models that were searched, where rivals of other models are looked up; by default
            only rivals of the objects' own models count.
        neighbours: other results, such as all of `localize`, that may occlude the objects; rejected
            ones occlude nothing.
        occluders: triangles in the world, m, of known obstacles that may occlude the objects, as
            for `localize`.

    Raises:
        TypeError: a calibration of another type, such as the views of a rig.
        ValueError: no object is left to look at, poses are in the base frame, neither candidates
            nor a distance are given, candidates are empty, not rigid or not in metres, a distance
            is not positive or not in metres, or no candidate is reachable or shows an object; the
            message says why.

    For example, after `found = sv.localize(...).accepted`, the position error in m that is left:

        >>> reachable = sv.localization.Reachable(distance=0.2)
        >>> round(sv.next_view(found, truth, reachable).position_std[1], 6)  # doctest: +SKIP
        7e-06
    """
    require_instance("calibration", calibration, Calibration, OF_ONE_CAMERA)
    objects = [obj for obj in localizations if obj.verdict.decision != "rejected"]
    if not objects:
        raise ValueError("localizations: nothing was found that a further view could verify")
    if any(obj.frame != "world" for obj in (*objects, *neighbours)):
        raise ValueError(
            "localizations: expected poses in the world frame of the calibration, found poses in "
            'the base frame: localise with RigViews(..., frame="world")'
        )
    vertices = np.concatenate(
        [host_transformed(obj.world_from_object, obj.model.vertices) for obj in objects]
    )
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    given = _checked_candidates(reachable)
    distance = _distance(reachable, given, middle)
    top = _top_surface_views(objects[0], calibration, distance)
    around = _around(middle, calibration, distance) if given is None else given
    candidates = np.concatenate([top, around])
    commands = viewpoint_commands(
        calibration, candidates, vertices, reachable.arm, reachable.near, reachable.limits
    )
    ok = np.asarray(commands.checks.ok)
    if not ok.any():
        reasons = sorted(set(commands.checks.reasons()))
        raise ValueError(f"reachable: none of {len(candidates)} views: {'; '.join(reasons[:4])}")
    triangles = checked_triangles(occluders)
    gains = ViewGains(objects, calibration, candidates, noise, models, neighbours, triangles)
    best = int(np.argmax(np.where(ok, gains.total, -np.inf)))
    if not gains.visible[best]:
        raise ValueError("reachable: no view that is reached shows an edge of the objects")
    poses = host_matrices(commands.base_from_tool)
    joints = None if commands.joints is None else np.asarray(commands.joints)

    def view(k: int, reason: str, paper: NextView | None) -> NextView:
        return NextView(
            poses[k],
            candidates[k],
            None if joints is None else joints[k],
            float(gains.discrimination[k]),
            (gains.std_before, float(gains.std_after[k])),
            float(gains.total[k]),
            reason,
            paper,
        )

    normals = [k for k in range(len(top)) if ok[k]]
    if not normals:
        return view(best, gains.reason(best, None), None)
    # Of the four rotations about the normal, take the one with the largest gain.
    k = max(normals, key=lambda turn: gains.total[turn])
    paper = view(k, "it looks along the normal of the localised top surface", None)
    return view(best, gains.reason(best, k), paper)


def _checked_candidates(reachable: Reachable) -> Float[np.ndarray, "n 4 4"] | None:
    """Return the given candidates as a batch, also a single one; None without candidates.

    Raises:
        ValueError: there are none, or one is not a rigid transform or not in metres.
    """
    if reachable.camera_from_world is None:
        return None
    given = np.asarray(reachable.camera_from_world, dtype=float)
    if given.shape[-2:] != (4, 4) or given.ndim > 3 or not given.size:
        raise ValueError(
            "reachable: camera_from_world: expected one pose or more, (n, 4, 4); found shape "
            f"{given.shape}"
        )
    candidates = given.reshape(-1, 4, 4)
    problems = check_rigid(candidates, tuple(f"candidate {k}" for k in range(len(candidates))))
    for candidate, text in problems.items():
        raise ValueError(f"reachable: camera_from_world: {candidate}: {text}")
    farthest = np.abs(candidates[:, :3, 3]).max()
    if farthest > MAX_COORDINATE:
        raise ValueError(
            f"reachable: camera_from_world: expected metres, up to {MAX_COORDINATE:g}; found "
            f"{farthest:.4g}"
        )
    return candidates


def _distance(
    reachable: Reachable,
    candidates: Float[np.ndarray, "n 4 4"] | None,
    middle: Float[np.ndarray, "3"],
) -> float:
    """Return the distance of the camera from the objects in new views, m."""
    if reachable.distance is not None:
        if not 0.0 < reachable.distance <= MAX_COORDINATE:
            raise ValueError(
                f"reachable: distance: expected metres, more than 0 and up to {MAX_COORDINATE:g}; "
                f"found {reachable.distance}"
            )
        return float(reachable.distance)
    if candidates is None:
        raise ValueError("reachable: give candidates, camera_from_world, or a distance")
    depths = candidates[:, 2, :3] @ middle + candidates[:, 2, 3]
    # A view with the objects behind it says nothing about how near the robot may come.
    in_front = depths[depths > 0.0]
    if not len(in_front):
        raise ValueError(
            f"reachable: camera_from_world: the objects are behind the camera in all "
            f"{len(depths)} views; is it world_from_camera?"
        )
    return float(np.median(in_front))


def _upwards(calibration: Calibration) -> Float[np.ndarray, "3"]:
    """Return the direction of the base's z axis in the world; the world's z for eye-to-hand."""
    if calibration.mount != "eye_in_hand":
        return np.array([0.0, 0.0, 1.0])
    return host_matrices(calibration.base_from_world)[2, :3]


def _top_surface_views(
    top_object: Localization, calibration: Calibration, distance: float
) -> Float[np.ndarray, "turns 4 4"]:
    """Return views along the normal of the face that points up most; none without faces."""
    model, pose = top_object.model, top_object.world_from_object
    if not model.faces:
        return np.zeros((0, 4, 4))
    planes = [face_plane(model.vertices, face) for face in model.faces]
    up = _upwards(calibration)
    heights = [float(up @ pose[:3, :3] @ plane.normal) for plane in planes]
    top = planes[int(np.argmax(heights))]
    normal = pose[:3, :3] @ top.normal
    origin = host_transformed(pose, top.origin)
    turns = np.deg2rad([0.0, 90.0, 180.0, 270.0])
    return host_matrices(look_at(origin, -normal, distance, turns))


def _around(
    middle: Float[np.ndarray, "3"], calibration: Calibration, distance: float
) -> Float[np.ndarray, "n 4 4"]:
    """Return views of the objects' middle from directions spread over a hemisphere."""
    up = _upwards(calibration)
    # From the zenith to the lowest elevation.
    local = spiral_directions(np.linspace(1.0, np.sin(LOWEST_ELEVATION), DIRECTIONS))
    # Any two axes perpendicular to the vertical complete the frame.
    across = np.linalg.svd(up[None])[2][1:]
    directions = local @ np.stack([across[0], np.cross(up, across[0]), up])
    return host_matrices(look_at(middle, -directions, distance))
