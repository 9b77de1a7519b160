"""Make an object model of what a person has clicked and drawn, and say what is missing."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from ..modeling import (
    Face,
    Grasp,
    ObjectModel,
    check_face,
    face_plane,
    grasp_on_face,
    oriented_outward,
)
from .document import Document, PlacedGrasp, part_id
from .view_geometry import PointEstimate, ViewGeometry

Estimates = Mapping[int, PointEstimate]
"""The estimates of points by id."""


def placed_points(document: Document, estimates: Estimates) -> list[int]:
    """Return the points that are vertices of the model: those that have a position."""
    # A point clicked once waits for its second view.
    return [point for point in document.points if not estimates[point].failure]


def build_model(
    document: Document,
    estimates: Estimates,
    names: Sequence[str],
    picture_covariance: Float[np.ndarray, "coordinates coordinates"] | None = None,
) -> ObjectModel:
    """Return the model of all points that have a position, with what can be made of them.

    Parts for which `problems_of` gives a reason are left out; the symmetry is not looked for.

    Args:
        document: the clicks and what was drawn.
        estimates: of all points.
        names: of the views, for the provenance.
        picture_covariance: of the coordinates of all `placed_points` together, m^2; None where
            they are independent, and their estimates say all.
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
    # Whoever finds the file later sees how much it rests on.
    clicks = sum(len(document.points[point]) for point in placed)
    covariance, factor = None, None
    if placed:
        covariance = picture_covariance
        if covariance is None:
            covariance = np.stack([estimates[point].picture_covariance for point in placed])
        factors = np.concatenate([estimates[point].calibration_factor for point in placed])
        # Without a covariance of the calibration there are no columns, and no second part.
        factor = factors if factors.shape[1] else None
    # Grasps are computed from the model that they belong to, so that comes first.
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
    """Return the grasp that is placed on a face of a model.

    Raises:
        ValueError: it is not on the face, or the fingers are not wide enough there.
    """
    plane = face_plane(model.vertices, model.faces[face])
    # Offsets and angles are in the plane's own axes, which move with it.
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
    """Return what cannot be part of a model and why, by kind and id."""
    found: dict[tuple[str, int], str] = {}
    for point, clicks in document.points.items():
        if estimates[point].failure:
            # The plain reason first: most points without a position lack only a second click.
            seen = f"clicked in {', '.join(clicks)} only" if len(clicks) < 2 else ""
            found["points", point] = seen or estimates[point].failure
    for edge, ends in document.edges.items():
        missing = [p for p in ends if ("points", p) in found]
        if missing:
            found["edges", edge] = f"point {missing[0]} has no position"
    for face, drawn in document.faces.items():
        reason = face_problem(drawn.loop, estimates)
        if reason:
            found["faces", face] = reason
    for grasp, placed in document.grasps.items():
        reason = found.get(("faces", placed.face)) or _grasp_problem(document, estimates, placed)
        if reason:
            found["grasps", grasp] = reason
    return found


def face_problem(loop: Sequence[int], estimates: Estimates) -> str:
    """Return what is wrong with a face, in words that name points by id; empty if nothing is."""
    missing = [p for p in loop if estimates[p].failure]
    if missing:
        return f"point {missing[0]} has no position"
    vertices = _positions(loop, estimates)
    # A clicked corner may be off the plane by its own uncertainty.
    sigma = np.sqrt([np.linalg.eigvalsh(estimates[p].covariance)[-1].clip(0.0) for p in loop])
    try:
        check_face(vertices, Face(tuple(range(len(loop)))), sigma)
    except ValueError as error:
        return str(error)
    return ""


def _grasp_problem(document: Document, estimates: Estimates, grasp: PlacedGrasp) -> str:
    """Return why a grasp cannot be made; empty if it can."""
    # Only the faces matter, and of those only the ones that are whole.
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
    """Return a face's loop so that its normal is towards the cameras that saw it.

    Raises:
        ValueError: a point that does not exist or has no position, or a face that is not planar or
            crosses itself.
    """
    points = tuple(part_id(point) for point in loop)
    for point in points:
        document.existing("points", point)
    if len(points) < 3:
        raise ValueError(f"a face goes around 3 or more points; found {list(points)}")
    # Said before anything is journalled, so that a refused face leaves no trace.
    reason = face_problem(points, estimates)
    if reason:
        raise ValueError(f"face {list(points)}: {reason}")
    plane = face_plane(_positions(points, estimates), Face(tuple(range(len(points)))))
    centres = geometry.centres
    # Cameras that did not see the face may be on either side of it.
    clicked = {view for point in points for view in document.points[point]}
    seen = [k for k, name in enumerate(geometry.names) if name in clicked]
    # Each camera that saw the face votes for its own side.
    votes = np.sign((centres[seen] - plane.origin) @ plane.normal).sum()
    return points if votes >= 0 else points[::-1]


def _positions(points: Sequence[int], estimates: Estimates) -> Float[np.ndarray, "points 3"]:
    """Return the positions of points, m."""
    return np.array([estimates[point].position for point in points]).reshape(-1, 3)
