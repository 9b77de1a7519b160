"""Choose the view that tells most about objects that were found, among those the robot reaches.

The paper's view looks along the normal of the localised top surface. Beside it stands the view of
the largest expected gain (`view_gains`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..calibration import Calibration
from ..engine import Noise
from ..geometry import host_matrices, look_at
from ..modeling import ObjectModel, face_plane
from ..robots import JointsLike, SerialArm
from ..viewpoints import Limits, viewpoint_commands
from .depth_buffers import checked_triangles
from .localization import Localization
from .view_gains import ViewGains

DIRECTIONS = 64
"""Number of directions, spread over a hemisphere, of the views that are tried by default."""

LOWEST_ELEVATION = float(np.deg2rad(25.0))
"""Smallest angle of these directions from the horizontal, rad."""


class Reachable(NamedTuple):
    """The views that a robot may take.

    Attributes:
        camera_from_world: candidates, `(n, 4, 4)`, or one, `(4, 4)`; None for directions over the
            object, at the distance of `distance`.
        distance: from the camera to the object, m; needed where there are no candidates. By
            default the paper's view is at the median of their distances along the optical axis.
        arm: the arm, with `near`; None where every pose within the limits is reached.
        near: joint readings near which the arm takes its views.
        limits: of viewpoints, as in `viewpoint_commands`.
    """

    camera_from_world: Float[np.ndarray, "*n 4 4"] | None = None
    distance: float | None = None
    arm: SerialArm | None = None
    near: JointsLike | None = None
    limits: Limits | None = None


class NextView(NamedTuple):
    """A view to take next, with what it is expected to tell.

    Attributes:
        base_from_tool: command.
        camera_from_world: the camera's pose there.
        joints: joint readings of the command; None without an arm.
        discrimination: expected log-likelihood of the objects over their rivals.
        position_std: of the objects' middles before and after the view, the largest, m.
        gain: of both kinds, natural units of information.
        reason: in words, as a clause that begins with a small letter.
        paper: the paper's view, along the normal of the top surface, likewise; None where the robot
            does not reach it, or for the paper's view itself.
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
    """Return the reachable view that tells the remaining hypotheses apart and shrinks the pose.

    Args:
        localizations: of `localize`; the rejected ones do not count.
        calibration: as for `localize`.
        reachable: the views that the robot may take.
        noise: of the robot, whose error in the new view limits what it tells; None for an exact
            robot.
        models: that were looked for, in which rivals of other models are found; by default rivals
            of the objects' own models only.
        neighbours: what else was found, such as all of `localize`, and may hide the objects;
            rejected ones hide nothing.
        occluders: triangles in the world, m, of what stands there and may hide the objects,
            as for `localize`.

    Raises:
        ValueError: no object is left to look at, neither candidates nor a distance are given,
            candidates are not 4x4 or there are none of them, or no candidate is reached or shows an
            object; the message says why.
    """
    objects = [one for one in localizations if one.verdict.decision != "rejected"]
    if not objects:
        raise ValueError("localizations: nothing was found that a further view could verify")
    vertices = np.concatenate([_in_world(one.model, one.world_from_object) for one in objects])
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    # One pose is a batch of one.
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
    # Of the turns about the normal the one of the largest gain.
    k = max(normals, key=lambda one: gains.total[one])
    paper = view(k, "it looks along the normal of the localised top surface", None)
    return view(best, gains.reason(best, k), paper)


def _checked_candidates(reachable: Reachable) -> Float[np.ndarray, "n 4 4"] | None:
    """Return the candidates that are given, one or many, as a batch; None without any."""
    if reachable.camera_from_world is None:
        return None
    given = np.asarray(reachable.camera_from_world, dtype=float)
    if given.shape[-2:] != (4, 4) or given.ndim > 3 or not given.size:
        raise ValueError(
            "reachable: camera_from_world: expected one pose or more, (n, 4, 4); found shape "
            f"{given.shape}"
        )
    return given.reshape(-1, 4, 4)


def _distance(
    reachable: Reachable,
    candidates: Float[np.ndarray, "n 4 4"] | None,
    middle: Float[np.ndarray, "3"],
) -> float:
    """Return the distance at which views of the objects' middle are made up, m."""
    if reachable.distance is not None:
        return float(reachable.distance)
    if candidates is None:
        raise ValueError("reachable: give candidates, camera_from_world, or a distance")
    depths = candidates[:, 2, :3] @ middle + candidates[:, 2, 3]
    # A view that has the objects behind it says nothing of how near the robot may come.
    before = depths[depths > 0.0]
    if not len(before):
        raise ValueError(
            f"reachable: camera_from_world: the objects are behind the camera in all "
            f"{len(depths)} views; is it world_from_camera?"
        )
    return float(np.median(before))


def _in_world(model: ObjectModel, pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "V 3"]:
    """Return a model's vertices in the world, m."""
    return model.vertices @ pose[:3, :3].T + pose[:3, 3]


def _upwards(calibration: Calibration) -> Float[np.ndarray, "3"]:
    """Return the direction of the base's z axis in the world; the world's z for eye-to-hand."""
    if calibration.mount != "eye_in_hand":
        return np.array([0.0, 0.0, 1.0])
    return host_matrices(calibration.base_from_world)[2, :3]


def _top_surface_views(
    one: Localization, calibration: Calibration, distance: float
) -> Float[np.ndarray, "turns 4 4"]:
    """Return views along the normal of the face that looks up most; none without faces."""
    model, pose = one.model, one.world_from_object
    if not model.faces:
        return np.zeros((0, 4, 4))
    planes = [face_plane(model.vertices, face) for face in model.faces]
    up = _upwards(calibration)
    heights = [float(up @ pose[:3, :3] @ plane.normal) for plane in planes]
    top = planes[int(np.argmax(heights))]
    normal = pose[:3, :3] @ top.normal
    origin = pose[:3, :3] @ top.origin + pose[:3, 3]
    turns = np.deg2rad([0.0, 90.0, 180.0, 270.0])
    return host_matrices(look_at(origin, -normal, distance, turns))


def _around(
    middle: Float[np.ndarray, "3"], calibration: Calibration, distance: float
) -> Float[np.ndarray, "n 4 4"]:
    """Return views of the objects' middle from directions spread over a hemisphere."""
    up = _upwards(calibration)
    # A spiral of equal areas between its turns, from the zenith to the lowest elevation.
    height = np.linspace(1.0, np.sin(LOWEST_ELEVATION), DIRECTIONS)
    angle = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(DIRECTIONS)
    around = np.sqrt(1.0 - height**2)
    local = np.column_stack([around * np.cos(angle), around * np.sin(angle), height])
    # Any two axes at right angles to the vertical complete it to a frame.
    across = np.linalg.svd(up[None])[2][1:]
    directions = local @ np.stack([across[0], np.cross(up, across[0]), up])
    return host_matrices(look_at(middle, -directions, distance))
