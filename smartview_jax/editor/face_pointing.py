"""Intersect the ray of a pixel with the faces that were drawn."""

from typing import Any

import numpy as np
from jaxtyping import Float

from ..modeling import Face, FacePlane, face_plane, points_in_loops
from .document import PlacedGrasp
from .model_building import face_problem
from .session import ModelSession


def drawn_plane(session: ModelSession, face: int) -> FacePlane:
    """Return the plane of a face given by its id."""
    loop, estimates = session.document.existing("faces", face).loop, session.estimates()
    vertices = np.array([estimates[p].position for p in loop])
    return face_plane(vertices, Face(tuple(range(len(loop)))))


def face_under(session: ModelSession, view: str, pixel: Any) -> tuple[int, Float[np.ndarray, "3"]]:
    """Return the nearest face under a pixel that faces the camera, and the point on it, m.

    Raises:
        ValueError: there is no such face, or the pixel is outside the picture.
    """
    origin, direction = session.geometry.ray(view, session.checked_pixel(view, pixel))
    estimates, hits = session.estimates(), []
    for number, face in session.document.faces.items():
        # A face with a problem may have no plane.
        if face_problem(face.loop, estimates):
            continue
        plane = drawn_plane(session, number)
        # A hit counts if it is in front of the camera, inside the loop, and on the face's
        # outside.
        depth = _meets(plane, origin, direction)
        point = origin + depth * direction
        loop = plane.coordinates(np.array([estimates[p].position for p in face.loop]))
        inside = points_in_loops(plane.coordinates(point[None]), [loop])[0]
        if plane.normal @ direction < 0.0 and depth > 0.0 and inside:
            hits.append((depth, number, point))
    if not hits:
        raise ValueError("no face here is turned towards this view; draw one first")
    # The nearest face occludes the others.
    _, number, point = min(hits, key=lambda hit: hit[0])
    return number, point


def angle_towards(session: ModelSession, grasp: PlacedGrasp, view: str, pixel: Any) -> float:
    """Return the angle on its face by which a grasp's fingers open towards a pixel, rad."""
    # In the face's axes, so that the grasp turns with the face when clicks move it.
    plane = drawn_plane(session, grasp.face)
    origin, direction = session.geometry.ray(view, session.checked_pixel(view, pixel))
    # The intersection of the pixel's ray with the face's plane.
    x, y = plane.coordinates((origin + _meets(plane, origin, direction) * direction)[None])[0]
    return float(np.arctan2(y - grasp.offset[1], x - grasp.offset[0]))


def _meets(plane: FacePlane, origin: np.ndarray, direction: np.ndarray) -> float:
    """Return the distance along a ray to a plane, m; infinite if they are parallel."""
    # normal . (origin + s direction - p) = 0, where p is a point of the plane.
    slope = float(plane.normal @ direction)
    return float(plane.normal @ (plane.origin - origin)) / slope if slope else float("inf")
