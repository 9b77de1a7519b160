"""Build an object model from a document, and list the parts that are incomplete."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from ..modeling import (
    Face,
    FacePlane,
    Grasp,
    ObjectModel,
    check_face,
    face_plane,
    grasp_on_face,
    oriented_outward,
)
from .document import Clicks, Document, PlacedGrasp
from .view_geometry import PointEstimate, ViewGeometry

Estimates = Mapping[int, PointEstimate]
"""The estimates of points by id."""


def placed_points(document: Document, estimates: Estimates) -> list[int]:
    """Return the points that have a position, which are the vertices of the model."""
    return [point for point in document.points if not estimates[point].failure]


def build_model(
    document: Document,
    estimates: Estimates,
    names: Sequence[str],
    picture_covariance: Float[np.ndarray, "coordinates coordinates"] | None = None,
) -> ObjectModel:
    """Return the model of all points that have a position, with its edges, faces and grasps.

    Parts in `problems_of` are left out; the symmetry is not computed. The covariance (m^2) is of
    the coordinates of all `placed_points`; without it the points are independent.
    """
    wrong = problems_of(document, estimates)
    placed = placed_points(document, estimates)
    number = {point: k for k, point in enumerate(placed)}
    face_ids = [face for face in document.faces if ("faces", face) not in wrong]
    drawn = [document.faces[face] for face in face_ids]
    vertices = _positions(placed, estimates)
    faces = oriented_outward(
        vertices,
        [Face(tuple(number[p] for p in f.loop), (), f.name, f.graspable) for f in drawn],
    )
    edges = [
        [number[a], number[b]]
        for edge, (a, b) in document.edges.items()
        if ("edges", edge) not in wrong
    ]
    # For the provenance.
    clicks = sum(len(document.points[point]) for point in placed)
    covariance, factor = None, None
    if placed:
        covariance = picture_covariance
        if covariance is None:
            covariance = np.stack([estimates[point].picture_covariance for point in placed])
        factors = np.concatenate([estimates[point].calibration_factor for point in placed])
        # Without a covariance of the calibration the factors have no columns.
        factor = factors if factors.shape[1] else None
    # Grasps are computed from the model without grasps.
    bare = ObjectModel(
        vertices,
        np.array(edges, int).reshape(-1, 2),
        faces,
        covariance,
        factor,
        name=document.name,
        provenance=(f"{clicks} clicks in the views {', '.join(names)}",),
    )
    grasps = tuple(
        placed_grasp(bare, face_ids.index(grasp.face), grasp)
        for key, grasp in document.grasps.items()
        if ("grasps", key) not in wrong
    )
    return dataclasses.replace(bare, grasps=grasps)


def placed_grasp(model: ObjectModel, face: int, grasp: PlacedGrasp) -> Grasp:
    """Return the grasp that is placed on a face of a model."""
    plane = face_plane(model.vertices, model.faces[face])
    x, y = plane.axes[:2]
    return grasp_on_face(
        model,
        face,
        plane.origin + grasp.offset[0] * x + grasp.offset[1] * y,
        np.cos(grasp.angle) * x + np.sin(grasp.angle) * y,
        grasp.opening,
        grasp.depth,
        grasp.name,
    )


def problems_of(document: Document, estimates: Estimates) -> dict[tuple[str, int], str]:
    """Return the parts that cannot be in a model, with the reasons, by kind and id."""
    problems: dict[tuple[str, int], str] = {}
    for point, clicks in document.points.items():
        if reason := point_problem(clicks, estimates[point]):
            problems["points", point] = reason
    for edge, ends in document.edges.items():
        missing = [p for p in ends if ("points", p) in problems]
        if missing:
            problems["edges", edge] = f"point {missing[0]} has no position"
    for face, drawn in document.faces.items():
        reason = face_problem(drawn.loop, estimates)
        if reason:
            problems["faces", face] = reason
    for grasp, placed in document.grasps.items():
        reason = problems.get(("faces", placed.face)) or _grasp_problem(document, estimates, placed)
        if reason:
            problems["grasps", grasp] = reason
    return problems


def loop_plane(loop: Sequence[int], estimates: Estimates) -> FacePlane:
    """Return the plane of a face around points that have positions."""
    return face_plane(_positions(loop, estimates), Face(tuple(range(len(loop)))))


def point_problem(clicks: Clicks, estimate: PointEstimate) -> str:
    """Return why a point has no position; empty if it has one."""
    # Most points without a position lack only a second click.
    is_single = bool(estimate.failure) and len(clicks) < 2
    return f"clicked in {', '.join(clicks)} only" if is_single else estimate.failure


def face_problem(loop: Sequence[int], estimates: Estimates) -> str:
    """Return the problem of a face, naming points by id; empty if there is none."""
    missing = [p for p in loop if estimates[p].failure]
    if missing:
        return f"point {missing[0]} has no position"
    # By their ids, which the message names; no face asks for what is between them.
    points = list(loop)
    vertices, sigma = np.zeros((max(points) + 1, 3)), np.zeros(max(points) + 1)
    vertices[points] = _positions(points, estimates)
    # A corner may be off the plane by its uncertainty.
    sigma[points] = np.sqrt(
        [np.linalg.eigvalsh(estimates[p].covariance)[-1].clip(0.0) for p in points]
    )
    try:
        check_face(vertices, Face(tuple(points)), sigma)
    except ValueError as error:
        return str(error)
    return ""


def _grasp_problem(document: Document, estimates: Estimates, grasp: PlacedGrasp) -> str:
    """Return why a grasp is not possible; empty if it is."""
    # Only complete faces matter.
    faces = {
        k: face for k, face in document.faces.items() if not face_problem(face.loop, estimates)
    }
    points = sorted({p for face in faces.values() for p in face.loop})
    number = {point: k for k, point in enumerate(points)}
    vertices = _positions(points, estimates)
    drawn = [Face(tuple(number[p] for p in face.loop)) for face in faces.values()]
    model = ObjectModel(
        vertices,
        faces=oriented_outward(vertices, drawn),
        covariance=np.stack([estimates[p].covariance for p in points]),
    )
    try:
        placed_grasp(model, list(faces).index(grasp.face), grasp)
    except ValueError as error:
        return str(error)
    return ""


def checked_loop(
    loop: Sequence[int], document: Document, estimates: Estimates, geometry: ViewGeometry
) -> tuple[int, ...]:
    """Return a face's loop, oriented so that its normal points to the cameras that saw it."""
    points = document.existing_points(loop)
    if len(points) < 3:
        raise ValueError(f"a face needs 3 or more points, found {list(points)}")
    # Checked before anything is journalled.
    reason = face_problem(points, estimates)
    if reason:
        raise ValueError(f"face {list(points)}: {reason}")
    plane = loop_plane(points, estimates)
    centres = geometry.centres
    # Only cameras that saw the face are known to be on its outside.
    clicked = {view for point in points for view in document.points[point]}
    cameras = [k for k, name in enumerate(geometry.names) if name in clicked]
    votes = np.sign((centres[cameras] - plane.origin) @ plane.normal).sum()
    return points if votes >= 0 else points[::-1]


def _positions(points: Sequence[int], estimates: Estimates) -> Float[np.ndarray, "points 3"]:
    """Return the positions of points, m."""
    return np.array([estimates[point].position for point in points]).reshape(-1, 3)
