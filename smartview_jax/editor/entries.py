"""Describe points, edges, faces and grasps for the page: plain numbers, few digits.

Lengths are in millimetres, for people; positions stay in metres.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ..modeling import EpipolarCurve, Grasp, Symmetry, width_between_fingers
from .disagreements import Disagreement
from .document import Clicks, DrawnFace
from .known_facts import FACT_KINDS
from .model_building import face_problem, loop_plane, point_problem
from .session import ModelSession
from .suggestions import Suggestion
from .view_geometry import PointEstimate, ViewGeometry

EDGE_SAMPLES = 7
"""Number of points by which an edge is drawn in a picture, because a lens bends it."""

MANY_TO_ONE = 1000
"""Largest odds that are shown as a number; larger ones rely too much on normal errors."""

_PIXEL_DIGITS, _METRE_DIGITS, _MILLIMETRE_DIGITS = 2, 7, 3


def point_entry(clicks: Clicks, estimate: PointEstimate) -> dict[str, Any]:
    """Return a point: its clicks, its position, and its predicted pixel in every view."""
    entry: dict[str, Any] = {"clicks": {view: list(pixel) for view, pixel in clicks.items()}}
    if estimate.wrong_clicks:
        entry["wrong"] = {view: str(click) for view, click in estimate.wrong_clicks.items()}
    if problem := point_problem(clicks, estimate):
        return {**entry, "problem": problem}
    # The half axes of the error ellipsoid are the eigenvectors times the roots of the eigenvalues.
    values, vectors = np.linalg.eigh(estimate.covariance)
    ellipses = [_ellipse(covariance) for covariance in estimate.ellipses]
    return {
        **entry,
        "at": estimate.position.round(_METRE_DIGITS).tolist(),
        "sigma_mm": (1e3 * np.sqrt(np.diag(estimate.covariance))).round(4).tolist(),
        # Columns are the half axes of the ellipsoid of one standard deviation, m.
        "ellipsoid": (vectors * np.sqrt(values.clip(0.0))).T.round(9).tolist(),
        "in": [
            [*pixel.round(_PIXEL_DIGITS).tolist(), *ellipse] if visible else None
            for pixel, ellipse, visible in zip(
                estimate.predicted, ellipses, estimate.visible, strict=True
            )
        ],
        "residuals": {
            view: [round(u, _PIXEL_DIGITS), round(v, _PIXEL_DIGITS)]
            for view, (u, v) in estimate.residuals.items()
        },
    }


def _ellipse(covariance: Float[np.ndarray, "2 2"]) -> list[float]:
    """Return the half axes (px) and the angle (rad) of the one-sigma ellipse."""
    # A point behind a camera has no pixel, and is not drawn.
    if not np.isfinite(covariance).all():
        return [0.0, 0.0, 0.0]
    # NumPy sorts eigenvalues in ascending order.
    values, vectors = np.linalg.eigh(covariance)
    short, long = np.sqrt(values.clip(0.0)).tolist()
    return [round(long, 3), round(short, 3), round(float(np.arctan2(*vectors[::-1, 1])), 4)]


def curve_entry(curve: EpipolarCurve) -> list[dict[str, list[float]]]:
    """Return the pieces of a curve in one view, with the depth of every sample, mm."""
    return [
        {
            "pixels": curve.pixels[curve.piece == k].round(1).ravel().tolist(),
            # JSON has no infinity.
            "mm": np.nan_to_num(1e3 * curve.depths[curve.piece == k], posinf=-1.0)
            .round(2)
            .tolist(),
        }
        for k in np.unique(curve.piece)
    ]


def edge_entries(
    edges: Mapping[int, tuple[int, int]],
    estimates: Mapping[int, PointEstimate],
    session: ModelSession,
) -> dict[int, dict[str, Any]]:
    """Return edges with their lengths, and as polylines in every view, by id."""
    entries: dict[int, dict[str, Any]] = {}
    complete = {}
    for number, (a, b) in edges.items():
        missing = [p for p in (a, b) if estimates[p].failure]
        entries[number] = {"ends": [a, b]}
        if missing:
            entries[number]["problem"] = f"point {missing[0]} has no position"
        else:
            complete[number] = (a, b)
    distances = session.distances(list(complete.values()))
    for number, (length, sigma) in zip(complete, distances, strict=True):
        entries[number] |= {"mm": round(1e3 * length, 3), "sigma_mm": round(1e3 * sigma, 3)}
    # All edges in one call.
    if complete:
        ends = np.array([[estimates[p].position for p in pair] for pair in complete.values()])
        t = np.linspace(0.0, 1.0, EDGE_SAMPLES)[None, :, None]
        samples = (1.0 - t) * ends[:, :1] + t * ends[:, 1:]
        for number, polylines in zip(complete, _polylines(session.geometry, samples), strict=True):
            entries[number]["in"] = polylines
    return entries


def _polylines(geometry: ViewGeometry, samples: Float[np.ndarray, "lines n 3"]) -> list[list[Any]]:
    """Return lines in space as polylines in every view, None if a part is behind the camera."""
    lines, count, _ = samples.shape
    pixels, valid = geometry.pixels_of(samples.reshape(-1, 3))
    views = len(pixels)
    pixels = pixels.reshape(views, lines, count, 2).round(_PIXEL_DIGITS)
    in_front = np.asarray(valid.reshape(views, lines, count).all(axis=2))
    return [
        [pixels[v, k].ravel().tolist() if in_front[v, k] else None for v in range(views)]
        for k in range(lines)
    ]


def face_entry(face: DrawnFace, estimates: Mapping[int, PointEstimate]) -> dict[str, Any]:
    """Return a face with its normal, or with its problem."""
    entry: dict[str, Any] = {
        "loop": list(face.loop),
        "name": face.name,
        "graspable": face.graspable,
    }
    if problem := face_problem(face.loop, estimates):
        return {**entry, "problem": problem}
    plane = loop_plane(face.loop, estimates)
    return {
        **entry,
        "centre": plane.origin.round(_METRE_DIGITS).tolist(),
        "normal": plane.normal.round(6).tolist(),
        "area_mm2": round(1e6 * plane.area, 1),
    }


def grasp_entry(grasp: Grasp, face: int, session: ModelSession) -> dict[str, Any]:
    """Return a grasp with the gripper's lines in space and in every view."""
    # A gripper as in the paper's Fig. 3: two fingers, the bar between them, and the approach. The
    # fingers reach `depth` below the face; the bar is above it.
    half, back = 0.5 * grasp.opening, grasp.depth + 0.6 * grasp.opening
    tool = np.array(
        [
            [[-half, 0, 0], [-half, 0, -back]],
            [[half, 0, 0], [half, 0, -back]],
            [[-half, 0, -back], [half, 0, -back]],
            [[0, 0, -1.5 * back], [0, 0, -grasp.depth]],
        ]
    )
    R, t = grasp.object_from_tool[:3, :3], grasp.object_from_tool[:3, 3]
    lines = tool @ R.T + t
    width = width_between_fingers(session.model(), grasp.object_from_tool)
    return {
        "face": face,
        "name": grasp.name,
        "opening_mm": round(1e3 * grasp.opening, 2),
        "depth_mm": round(1e3 * grasp.depth, 2),
        "tolerance_mm": round(1e3 * grasp.tolerance, 2),
        "width_mm": None if width is None else round(1e3 * width, 2),
        "lines": lines.round(_METRE_DIGITS).tolist(),
        "in": _polylines(session.geometry, lines),
    }


def offer_message(session: ModelSession) -> dict[str, Any]:
    """Return the proposed points that are neither accepted nor rejected, best supported first."""
    offer, names = session.proposals, session.names
    points = [
        {
            "number": number,
            "in": [point.clicks.get(name) for name in names],
            "views": len(point.clicks),
            "rms": round(point.rms, 2),
        }
        for number, point in offer.points.items()
    ]
    # Edges between two undecided points.
    edges = [pair for pair in offer.edges if set(pair) <= set(offer.points)]
    return {"type": "proposals", "offer": {"points": points, "edges": edges}}


def symmetry_entry(symmetry: Symmetry, confirmed: bool | None) -> dict[str, Any]:
    """Return a symmetry in words, with its axes, and whether it was confirmed (None: open)."""
    return {
        "order": symmetry.order,
        "words": symmetry.words,
        "round": symmetry.axis is not None,
        "centre": symmetry.centre.round(_METRE_DIGITS).tolist(),
        "axes": [axis.direction.round(6).tolist() for axis in symmetry.axes],
        "said": confirmed,
    }


def disagreement_entry(disagreement: Disagreement) -> dict[str, Any]:
    """Return a disagreement in words, with the residuals by point and view, px."""
    residuals = disagreement.residuals.items()
    return {
        **disagreement._asdict(),
        "suspects": list(map(list, disagreement.suspects)),
        "residuals": [[*click, round(size, _PIXEL_DIGITS)] for click, size in residuals],
    }


def suggestion_entry(fact: Suggestion) -> dict[str, Any]:
    """Return a suggested fact in words, with the constraint that would state it."""
    # Lengths in mm, angles in degrees.
    scale, unit = (1e3, "mm") if fact.kind == "equal_length" else (np.rad2deg(1.0), "degrees")
    return {
        "kind": fact.kind,
        "items": list(map(list, fact.items)),
        "words": FACT_KINDS[fact.kind].words,
        "why": f"off by {scale * fact.deviation:.2f} ± {scale * fact.sigma:.2f} {unit}",
        "odds": f"{fact.odds:.0f} : 1" if fact.odds < MANY_TO_ONE else f"> {MANY_TO_ONE} : 1",
    }
