"""Place a gripper on a face of an object model: the grasping coordinates of the paper's Fig. 3.

The frame of a grasp is the tool's: z is the approach, along the face's inward normal; x is the
opening direction, along which the fingers close; the origin is the point between the fingertips,
at the grasp's depth below the face. `object_from_tool` of Eq. 20 is the pose of this frame.
"""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ...argument_checks import require_readable_or_empty
from ...geometry import host_poses
from .faces import face_plane, points_in_loops

if TYPE_CHECKING:
    from .object_model import ObjectModel

_ON_SURFACE = 1e-9
"""Largest distance between two points that count as one, relative to the object's extent."""


@dataclasses.dataclass(frozen=True, eq=False)
class Grasp:
    """A pose of the gripper on a face of an object.

    Attributes:
        name: for people.
        face: index of the face that the gripper approaches.
        object_from_tool: pose of the tool in the object's frame, 4x4, m.
        opening: distance between the fingers before they close, m.
        depth: of the fingertips below the face, m.
        tolerance: largest position error along the opening direction with which the object is still
            between the fingers, m.
    """

    name: str
    face: int
    object_from_tool: Float[np.ndarray, "4 4"]
    opening: float
    depth: float
    tolerance: float

    def __post_init__(self) -> None:
        """Raise a ValueError for a name that no file could hold; there may be none."""
        require_readable_or_empty("grasp", self.name)

    @property
    def approach(self) -> Float[np.ndarray, "3"]:
        """The direction in which the gripper approaches, in the object's frame."""
        return self.object_from_tool[:3, 2]

    @property
    def opening_direction(self) -> Float[np.ndarray, "3"]:
        """The direction along which the fingers close, in the object's frame."""
        return self.object_from_tool[:3, 0]

    @property
    def position(self) -> Float[np.ndarray, "3"]:
        """The point of the face above the fingertips, in the object's frame, m."""
        return self.object_from_tool[:3, 3] - self.depth * self.approach


def grasp_on_face(
    model: "ObjectModel",
    face: int,
    position: Float[np.ndarray, "3"] | None = None,
    opening_direction: Float[np.ndarray, "3"] | None = None,
    opening: float | None = None,
    depth: float = 0.01,
    name: str = "",
) -> Grasp:
    """Return the grasp at a point of a face, approached along the inward normal.

    Args:
        position: a point, moved along the normal onto the face, m; by default the mean of the
            face's corners.
        opening_direction: turned into the plane of the face; by default across the longest edge.
        opening: distance between the open fingers, m; by default 1.2 times the width there,
            or the extent of the face where the model is open and has no width.
        depth: of the fingertips below the face, m.
        name: for people.

    Raises:
        ValueError: there is no such face, the position is not on it, the opening direction is along
            the normal, or the fingers are not wide enough for the object there.
    """
    if not 0 <= face < len(model.faces):
        raise ValueError(f"face {face} does not exist: the model has {len(model.faces)} faces")
    plane = face_plane(model.vertices, model.faces[face])
    point = plane.origin if position is None else np.asarray(position, dtype=float)
    # A clicked or computed position is on the plane only up to rounding.
    point = point - plane.normal * (plane.normal @ (point - plane.origin))
    loops = [plane.coordinates(model.vertices[list(loop)]) for loop in model.faces[face].loops]
    if not points_in_loops(plane.coordinates(point[None]), loops)[0]:
        raise ValueError(f"its position is not on face {face}")
    frame = _tool_axes(
        plane.normal, plane.axes[1] if opening_direction is None else opening_direction
    )
    object_from_tool = host_poses(frame, point - depth * plane.normal)
    # At the fingertips' depth, which is where they close.
    width = width_between_fingers(model, object_from_tool)
    if opening is None:
        # Where the model is open its width is unknown, and the face's own extent is used.
        corners = model.vertices[model.faces[face].indices]
        opening = 1.2 * (float(np.ptp(corners @ frame[:, 0])) if width is None else width)
    # Half of the clearance is on either side of the object.
    room = opening - (0.0 if width is None else width)
    if not (opening > 0.0 and room > 0.0 and depth >= 0.0):
        raise ValueError(
            f"an opening of {1e3 * opening:.3g} mm at a depth of "
            f"{1e3 * depth:.3g} mm; the object is {1e3 * (width or 0.0):.3g} mm wide there"
        )
    return Grasp(name, face, object_from_tool, float(opening), float(depth), 0.5 * float(room))


def _tool_axes(
    normal: Float[np.ndarray, "3"], opening_direction: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """Return the tool's axes as columns: x in the face along the opening, z inward."""
    # Only the component of the direction in the face counts.
    direction = np.asarray(opening_direction, dtype=float)
    x = direction - normal * (normal @ direction)
    length = float(np.linalg.norm(x))
    if not length > 1e-6 * float(np.linalg.norm(direction)):
        raise ValueError("the opening direction is along the normal of the face, or zero")
    return np.column_stack([x / length, np.cross(-normal, x / length), -normal])


def width_between_fingers(
    model: "ObjectModel", object_from_tool: Float[np.ndarray, "4 4"]
) -> float | None:
    """Return the width of the object along the opening direction of a tool pose, m.

    It is the distance between the outermost surface points on both sides of the tool's origin;
    None where the model has no face on one of the sides.
    """
    width = float(widths_between_fingers(model, object_from_tool[None])[0])
    return None if np.isnan(width) else width


def widths_between_fingers(
    model: "ObjectModel", object_from_tool: Float[np.ndarray, "poses 4 4"]
) -> Float[np.ndarray, "poses"]:
    """Return `width_between_fingers` for many tool poses; NaN where there is none."""
    origins, directions = object_from_tool[:, :3, 3], object_from_tool[:, :3, 0]
    # The outermost hits on both sides, since fingers close from outside, over hollows.
    scale = _ON_SURFACE * model.extent
    ahead, behind = np.full(len(origins), -np.inf), np.full(len(origins), np.inf)
    for face in model.faces:
        plane = face_plane(model.vertices, face)
        slopes = directions @ plane.normal
        across = np.flatnonzero(np.abs(slopes) >= 1e-9)
        if not len(across):
            continue
        # origin + s direction is on the plane where normal . (origin + s direction - p) = 0.
        s = (plane.origin - origins[across]) @ plane.normal / slopes[across]
        hits = plane.coordinates(origins[across] + s[:, None] * directions[across])
        loops = [plane.coordinates(model.vertices[list(loop)]) for loop in face.loops]
        inside = points_in_loops(hits, loops)
        hit, s = across[inside], s[inside]
        ahead[hit[s > scale]] = np.maximum(ahead[hit[s > scale]], s[s > scale])
        behind[hit[s < -scale]] = np.minimum(behind[hit[s < -scale]], s[s < -scale])
    # Infinite on a side without a face.
    both = np.isfinite(ahead) & np.isfinite(behind)
    return np.where(both, np.where(both, ahead, 0.0) - np.where(both, behind, 0.0), np.nan)
