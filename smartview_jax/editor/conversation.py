"""Answer the messages of a page: one conversation for each page that shows a session.

A message is a mapping with `do`, the name of a change or of a command of this file, and `message`,
a number by which the page matches the answer. An answer contains only the parts that changed, not
the whole model.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ..modeling import FacePlane, points_in_loops
from .document import CHANGES, KINDS, PlacedGrasp
from .entries import (
    curve_entry,
    disagreement_entry,
    edge_entries,
    face_entry,
    grasp_entry,
    offer_message,
    point_entry,
    suggestion_entry,
    symmetry_entry,
)
from .kept_results import are_same_objects
from .known_facts import FACT_KINDS
from .model_building import face_problem, loop_plane, placed_grasp, problems_of
from .session import ModelSession

Message = dict[str, Any]
"""A mapping of plain values, as in JSON."""


SLOW_COMMANDS = ("features", "propose", "symmetry", "judge")
"""Commands that do not change the document and may take seconds."""

COMMANDS = (
    *SLOW_COMMANDS,
    *("hover", "check", "undo", "redo", "save", "distance", "accept", "reject"),
    *("grasp_at", "turn_grasp"),
)
"""The methods of a conversation that a page calls by name, in addition to the changes."""


class Conversation:
    """The exchange with one page; keeps what the page has been shown."""

    def __init__(self, session: ModelSession):
        """Begin a conversation with a page that shows nothing yet."""
        self._session = session
        # The objects from which each of the page's entries was made, by kind and id.
        self._shown: dict[str, dict[int, tuple]] = {kind: {} for kind in KINDS}

    def answer(self, message: Mapping[str, Any]) -> Message:
        """Return the answer to a message; an error is also an answer, and changes nothing."""
        # The page matches answers by this number, because slow commands are answered out of order.
        content = dict(message)
        number, name = content.pop("message", None), content.get("do")
        try:
            if name == "hello" or name in COMMANDS:
                content.pop("do")
                command = self.greeting if name == "hello" else getattr(self, name)
                reply = command(**content)
            else:
                reply = self._changed(content)
        # Messages are not validated, and the disk may be full, so any exception is answered. The
        # session stays valid: it keeps a change only after everything succeeded.
        except Exception as error:
            reply = {"type": "error", "text": str(error) or type(error).__name__}
        return {**reply, "reply_to": number}

    def _changed(self, change: Message) -> Message:
        """Make a change of the document, and return the parts that changed."""
        if change.get("do") not in CHANGES:
            raise ValueError(f"unknown command {change.get('do')!r}")
        # Faces and grasps are checked against the geometry, which the document does not have.
        session, before = self._session, self._session.document.next_id
        # The session orients a new face towards the cameras, and refuses a face that is not flat.
        if change["do"] == "add_face":
            session.add_face(
                change.get("loop", ()), change.get("name", ""), change.get("graspable")
            )
        elif change["do"] == "change_grasp":
            values = {key: value for key, value in change.items() if key not in ("do", "id")}
            session.change_grasp(change.get("id", -1), **values)
        else:
            session.change(change)
        return {**self.update(), "new": before if session.document.next_id > before else None}

    def greeting(self) -> Message:
        """Return the views and the whole model; the first message to a page."""
        session = self._session
        # A reloaded page shows nothing.
        self._shown = {kind: {} for kind in KINDS}
        poses = np.linalg.inv(session.geometry.camera_from_world)
        return {
            **self.update(),
            "type": "greeting",
            "file": None if session.path is None else session.path.name,
            "notes": session.notes,
            "facts": [
                {"kind": name, **kind._asdict(), "build": None} for name, kind in FACT_KINDS.items()
            ],
            "click_sigma": session.geometry.click_sigma,
            "views": [
                {
                    "name": name,
                    "size": list(camera.image_size),
                    "focal_px": float(camera.alpha_u),
                    "world_from_camera": pose.round(9).tolist(),
                }
                for (name, camera), pose in zip(session.cameras.items(), poses, strict=True)
            ],
        }

    def update(self) -> Message:
        """Return what has changed since the last message to the page."""
        session = self._session
        document, estimates = session.document, session.estimates()
        # A part's entry is recomputed if the part or a point that it needs is a new object.
        sources: dict[str, dict[int, tuple]] = {
            "points": {k: (clicks, estimates[k]) for k, clicks in document.points.items()},
            "edges": {k: (e, *(estimates[p] for p in e)) for k, e in document.edges.items()},
            "faces": {k: (f, *(estimates[p] for p in f.loop)) for k, f in document.faces.items()},
            "constraints": {k: (fact, estimates) for k, fact in document.constraints.items()},
        }
        # The width between the fingers depends on all faces, so grasps are recomputed with any
        # face.
        surface = tuple(part for source in sources["faces"].values() for part in source)
        sources["grasps"] = {k: (g, *surface) for k, g in document.grasps.items()}
        parts: dict[str, dict[int, Any]] = {}
        for kind, source in sources.items():
            shown = self._shown[kind]
            new = [
                k for k, parts_of in source.items() if not are_same_objects(shown.get(k), parts_of)
            ]
            # None tells the page that a part was deleted.
            deleted = [k for k in shown if k not in source]
            parts[kind] = {**self._entries(kind, new, estimates), **dict.fromkeys(deleted)}
            self._shown[kind] = source
        return {"type": "update", "parts": parts, **self.status()}

    def _entries(self, kind: str, numbers: list[int], estimates: Any) -> dict[int, Any]:
        """Return the entries of parts of one kind."""
        session, document = self._session, self._session.document
        if kind == "points":
            return {k: point_entry(document.points[k], estimates[k]) for k in numbers}
        if kind == "edges":
            edges = {k: document.edges[k] for k in numbers}
            return edge_entries(edges, estimates, session)
        if kind == "faces":
            return {k: face_entry(document.faces[k], estimates) for k in numbers}
        if kind == "constraints":
            return {k: self._constraint_entry(k) for k in numbers}
        return {k: self._grasp_entry(k, document.grasps[k]) for k in numbers}

    def _constraint_entry(self, number: int) -> Message:
        """Return a constraint in words."""
        fact = self._session.document.constraints[number]
        # A constraint that contradicts the pictures is shown in red with its cost.
        doubt = self._session.findings().contradiction(number)
        return {
            **({"problem": doubt} if doubt else {}),
            "words": FACT_KINDS[fact.kind].words,
            "kind": fact.kind,
            "items": [list(group) for group in fact.items],
            "value_mm": None if fact.value is None else round(1e3 * fact.value, 3),
            "sigma": fact.sigma,
        }

    def _grasp_entry(self, number: int, grasp: PlacedGrasp) -> Message:
        """Return a grasp, or the reason why it is not possible."""
        session = self._session
        problem = problems_of(session.document, session.estimates()).get(("grasps", number))
        if problem:
            return {"face": grasp.face, "name": grasp.name, "problem": problem}
        model, index = session.model(), self._face_index(grasp.face)
        return grasp_entry(placed_grasp(model, index, grasp), grasp.face, session)

    def _face_index(self, face: int) -> int:
        """Return the index in the model of a face given by its id."""
        session = self._session
        # The model has only the complete faces, in the document's order.
        wrong = problems_of(session.document, session.estimates())
        return [k for k in session.document.faces if ("faces", k) not in wrong].index(face)

    def status(self) -> Message:
        """Return what the status bar shows."""
        session = self._session
        return {
            "can_undo": session.can_undo,
            "can_redo": session.can_redo,
            "saved": session.is_saved,
            "kept": session.path is not None,
            "name": session.document.name,
        }

    def hover(self, view: str, pixel: Any) -> Message:
        """Return the curves of a pixel in the other views, with the depth of every sample."""
        # The mouse may be outside the picture.
        checked = self._session.checked_pixel(view, pixel)
        curves = {
            name: curve_entry(curve) for name, curve in self._session.curves(view, checked).items()
        }
        return {"type": "curves", "view": view, "pixel": list(checked), "curves": curves}

    def features(self, view: str) -> Message:
        """Return the corners and segments of a view's picture, which clicks snap to."""
        features = self._session.features(view)
        return {
            "type": "features",
            "view": view,
            "corners": features.corners.round(3).tolist(),
            # In px^2: uu, uv, vv.
            "covariances": features.corner_covariances[:, [0, 0, 1], [0, 1, 1]].round(5).tolist(),
            "segments": features.segments.round(2).reshape(-1, 4).tolist(),
        }

    def check(self, change: Mapping[str, Any]) -> Message:
        """Return why a change would be refused, or nothing; the change is not made."""
        try:
            self._session.checked(change)
        except ValueError as error:
            return {"type": "check", "problem": str(error)}
        return {"type": "check", "problem": ""}

    def judge(self) -> Message:
        """Return what disagrees, and the facts that the data suggest."""
        session = self._session
        return {
            "type": "judgement",
            "disagreements": [disagreement_entry(entry) for entry in session.disagreements()],
            "suggestions": [suggestion_entry(entry) for entry in session.suggestions()],
        }

    def undo(self) -> Message:
        """Undo the last change."""
        self._session.undo()
        return self.update()

    def redo(self) -> Message:
        """Redo the change that was undone last."""
        self._session.redo()
        return self.update()

    def save(self) -> Message:
        """Write the model's file."""
        # A model with incomplete parts is saved without them, with a note on their number.
        session = self._session
        path = session.save()
        left_out = session.problems()
        words = f"; {len(left_out)} incomplete parts left out" if left_out else ""
        doubted = session.disagreements()
        words += f"; disagreements: {len(doubted)}" if doubted else ""
        return {**self.update(), "note": f"saved to {path}{words}"}

    def propose(self, rectangles: Mapping[str, Any] | None = None) -> Message:
        """Match all views automatically, and offer the points and edges found in rectangles."""
        self._session.propose(rectangles=rectangles)
        return offer_message(self._session)

    def accept(self, points: list[int]) -> Message:
        """Add proposed points to the model."""
        self._session.accept(points)
        # The points added, and those still to be decided.
        return {**self.update(), **offer_message(self._session), "type": "update"}

    def reject(self, points: list[int]) -> Message:
        """Remove proposed points from the offer."""
        self._session.reject(points)
        return offer_message(self._session)

    def symmetry(self) -> Message:
        """Return the symmetry of the object's geometry, and whether it was confirmed."""
        session = self._session
        symmetry = session.symmetry()
        entry = None if symmetry is None else symmetry_entry(symmetry, session.symmetry_said)
        return {"type": "symmetry", "symmetry": entry}

    def distance(self, a: int, b: int) -> Message:
        """Return the distance between two points with its standard deviation."""
        length, sigma = self._session.distance(a, b)
        return {"type": "distance", "a": a, "b": b, "mm": 1e3 * length, "sigma_mm": 1e3 * sigma}

    def grasp_at(self, view: str, pixel: Any, depth: float = 0.01) -> Message:
        """Place a grasp where a pixel's ray meets the nearest face towards the camera."""
        face, point = face_under(self._session, view, pixel)
        # Relative to the face, so that the grasp follows when clicks move the face.
        offset = drawn_plane(self._session, face).coordinates(point[None])[0].tolist()
        number = self._session.add_grasp(face, offset=offset, depth=depth)
        return {**self.update(), "new": number}

    def turn_grasp(self, grasp: int, view: str, pixel: Any, commit: bool = False) -> Message:
        """Turn a grasp so that its fingers open towards a pixel; kept only on `commit`."""
        session = self._session
        placed = session.document.existing("grasps", grasp)
        angle = angle_towards(session, placed, view, pixel)
        if commit:
            session.change_grasp(grasp, angle=angle)
            return self.update()
        # While the mouse moves nothing is kept, so that the journal gets one turn, not hundreds.
        turned = dataclasses.replace(placed, angle=angle)
        made = placed_grasp(session.model(), self._face_index(placed.face), turned)
        entry = grasp_entry(made, placed.face, session)
        return {"type": "preview", "grasp": grasp, "entry": entry}


def drawn_plane(session: ModelSession, face: int) -> FacePlane:
    """Return the plane of a face given by its id."""
    return loop_plane(session.document.existing("faces", face).loop, session.estimates())


def face_under(session: ModelSession, view: str, pixel: Any) -> tuple[int, Float[np.ndarray, "3"]]:
    """Return the nearest face under a pixel that faces the camera, and the point on it, m."""
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
