"""Find what a gripper and the links of an arm would touch, with python-fcl.

Everything that moves is treated as convex, and so is its sweep along a straight line, the convex
hull of its two ends. So nothing in between is missed, as it could be by sampling poses. The links
of the arm, which turn, are swept in short steps. fcl is called directly: trimesh's collision
manager repairs and checks every mesh, which takes twenty times as long for sweeps that are used
once.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from ..extras import import_extra
from ..geometry import host_transformed
from ..robots import Gripper
from .scene import Obstacle

LINK_SIDES = 10
"""Number of sides of the prism that encloses the cylinder about a link of the arm."""

CONVEX_TOLERANCE = 1e-9
"""Largest distance of a vertex outside a triangle's plane in a convex mesh, over its extent."""

RESTING_OVERLAP = 1e-3
"""Depth to which a held object may penetrate obstacles, m.

It touches whatever it stands on and leans against, and its pose is not exact.
"""


class Contact(NamedTuple):
    """The smallest distance (clearance, m) of a moving part from an obstacle; zero at contact."""

    part: str
    obstacle: str
    clearance: float

    def __str__(self) -> str:
        """Return a sentence without its full stop."""
        if self.clearance > 0.0:
            return f"the {self.part} comes too close to {self.obstacle}"
        return f"the {self.part} touches {self.obstacle}"


class CollisionChecker:
    """Obstacles prepared for distance queries."""

    def __init__(self, obstacles: Sequence[Obstacle]):
        """Prepare the obstacles; raise an ImportError without python-fcl."""
        self._fcl = import_extra("fcl", "cell", "checking collisions")
        self._names = [obstacle.name for obstacle in obstacles]
        # Bounding boxes rule out most pairs before fcl is called.
        self._boxes = [
            (obstacle.vertices.min(axis=0), obstacle.vertices.max(axis=0)) for obstacle in obstacles
        ]
        self._objects = [self._obstacle(obstacle) for obstacle in obstacles]

    def nearest(
        self, parts: dict[str, Float[np.ndarray, "corners 3"]], within: float = np.inf
    ) -> Contact | None:
        """Return where convex parts, given by points in the world, come nearest to an obstacle.

        None if there are no obstacles, or none within a distance (m), which shortens the search.
        """
        best: Contact | None = None
        for part, corners in parts.items():
            moving = None
            lower, upper = corners.min(axis=0), corners.max(axis=0)
            for name, obstacle, (low, high) in zip(
                self._names, self._objects, self._boxes, strict=True
            ):
                # The boxes are no farther apart than their contents.
                gap = np.linalg.norm(np.maximum(0.0, np.maximum(low - upper, lower - high)))
                if gap >= within:
                    continue
                moving = moving or self._convex(corners, ConvexHull(corners).simplices)
                distance = self._distance(moving, obstacle)
                if distance < within:
                    best, within = Contact(part, name, distance), distance
        return best

    def _distance(self, moving: Any, obstacle: Any) -> float:
        """Return the distance of two shapes, m; zero where they touch."""
        fcl = self._fcl
        if fcl.collide(moving, obstacle, fcl.CollisionRequest(), fcl.CollisionResult()):
            return 0.0
        # fcl reports penetration as a negative distance, or as zero, by the kind of shape.
        result = fcl.DistanceResult()
        return max(float(fcl.distance(moving, obstacle, fcl.DistanceRequest(), result)), 0.0)

    def _obstacle(self, obstacle: Obstacle) -> Any:
        """Return an obstacle as a convex solid where it is convex, else as a surface."""
        corners = obstacle.vertices[obstacle.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        # Convex if no vertex is beyond the plane of any triangle.
        beyond = np.einsum("tvi,ti->tv", obstacle.vertices[None] - corners[:, :1], normals)
        scale = (
            np.linalg.norm(normals, axis=1, keepdims=True) * np.ptp(obstacle.vertices, axis=0).max()
        )
        if (beyond <= CONVEX_TOLERANCE * scale).all():
            return self._convex(obstacle.vertices, obstacle.triangles)
        # For fcl a surface has no inside; nothing that moves is small enough to fit inside.
        surface = self._fcl.BVHModel()
        surface.beginModel(len(obstacle.vertices), len(obstacle.triangles))
        surface.addSubModel(obstacle.vertices, obstacle.triangles)
        surface.endModel()
        return self._fcl.CollisionObject(surface, self._fcl.Transform())

    def _convex(
        self, vertices: Float[np.ndarray, "vertices 3"], triangles: Int[np.ndarray, "triangles 3"]
    ) -> Any:
        # fcl takes faces as one list, each after its number of vertices.
        faces = np.column_stack([np.full(len(triangles), 3), triangles]).ravel()
        solid = self._fcl.Convex(np.ascontiguousarray(vertices), len(triangles), faces)
        return self._fcl.CollisionObject(solid, self._fcl.Transform())


def swept_gripper(
    gripper: Gripper,
    opening: float,
    world_from_gripper: Float[np.ndarray, "4 4"],
    translation: Float[np.ndarray, "3"],
) -> dict[str, Float[np.ndarray, "16 3"]]:
    """Return the corners of the volume that a gripper sweeps on a straight line from a pose, m."""
    swept = {}
    for box in gripper.boxes(opening):
        corners = host_transformed(world_from_gripper, box.vertices)
        swept[box.name] = np.concatenate([corners, corners + translation])
    return swept


def closing_fingers(
    gripper: Gripper, opening: float, width: float, world_from_gripper: Float[np.ndarray, "4 4"]
) -> dict[str, Float[np.ndarray, "16 3"]]:
    """Return the corners of the volume that the fingers sweep while they close.

    A wall between an open finger and the object would touch neither end of this motion.
    """
    both = zip(gripper.boxes(opening)[1:], gripper.boxes(width)[1:], strict=True)
    return {
        before.name: host_transformed(
            world_from_gripper, np.concatenate([before.vertices, after.vertices])
        )
        for before, after in both
    }


def swept_object(
    vertices: Float[np.ndarray, "vertices 3"], translation: Float[np.ndarray, "3"]
) -> dict[str, Float[np.ndarray, "corners 3"]]:
    """Return the corners of the volume that a held object sweeps on a straight line, m.

    It is the sweep of the object's convex hull, shrunk by `RESTING_OVERLAP` on all sides.
    """
    corners = _shrunk_hull(vertices, translation)
    return {"held object": np.concatenate([corners, corners + translation])}


def _shrunk_hull(
    vertices: Float[np.ndarray, "vertices 3"], translation: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "corners 3"]:
    """Return the corners of a convex hull whose faces are moved inwards by `RESTING_OVERLAP`.

    Flat vertices are moved along a translation instead, and thickened slightly.
    """
    try:
        hull = ConvexHull(vertices)
    except QhullError:
        # A model of one face has no inside: it is lifted off its support.
        lifted = vertices + RESTING_OVERLAP * translation / np.linalg.norm(translation)
        normal = np.linalg.svd(vertices - vertices.mean(axis=0))[2][2]
        # A flat set may stay flat when it is swept, and Qhull cannot handle that.
        thickness = 0.1 * RESTING_OVERLAP * normal
        return np.concatenate([lifted - thickness, lifted + thickness])
    middle = vertices[hull.vertices].mean(axis=0)
    normals, offsets = hull.equations[:, :3], hull.equations[:, 3]
    # Thin objects are not shrunk to nothing.
    inset = min(RESTING_OVERLAP, -0.5 * float((normals @ middle + offsets).max()))
    faces = np.column_stack([normals, offsets + inset])
    return HalfspaceIntersection(faces, middle).intersections


def swept_links(
    origins: Float[np.ndarray, "steps frames 3"], radius: float
) -> Iterator[dict[str, Float[np.ndarray, "corners 3"]]]:
    """Yield the corners of the volumes that an arm's links sweep from each step to the next, m.

    A link is a cylinder between two origins of frames along the arm, in the world.
    """
    for before, after in pairwise(arm_links(frames, radius) for frames in origins):
        # A sliding joint may start at zero length, where its link has no direction.
        yield {
            name: np.concatenate([before[name], after[name]]) for name in before if name in after
        }


def arm_links(
    origins: Float[np.ndarray, "frames 3"], radius: float
) -> dict[str, Float[np.ndarray, "corners 3"]]:
    """Return the corners of cylinders about the links of an arm, from frame to frame, m."""
    links = {}
    for k, (start, end) in enumerate(pairwise(origins)):
        axis = end - start
        # Frames of intersecting axes share their origin, with no link between them.
        if np.linalg.norm(axis) < 1e-6:
            continue
        across = np.linalg.svd(axis[None])[2][1:]
        angles = 2.0 * np.pi * np.arange(LINK_SIDES) / LINK_SIDES
        # Circumscribed, so that the prism encloses the cylinder.
        outer = radius / np.cos(np.pi / LINK_SIDES)
        ring = outer * np.column_stack([np.cos(angles), np.sin(angles)]) @ across
        links[f"arm's link {1 + k}"] = np.concatenate([start + ring, end + ring])
    return links
