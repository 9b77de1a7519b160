"""Edit an object model: the one class behind the page, the notebook's widget and scripts.

with ModelSession(calibration, base_from_tool, pictures, path="bracket.json") as session:
corner = session.click("v1", (312.4, 201.9))
session.click("v2", (298.1, 215.0), corner)
session.save()
"""

import contextlib
import dataclasses
import operator
import os
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from jaxtyping import Float

from ..calibration import Calibration
from ..evaluation import CalibrationEstimate
from ..features import Features
from ..features import find as find_features
from ..io import save_object_model
from ..modeling import ConstraintVerdict, EpipolarCurve, ObjectModel, propose_model
from .document import Document, apply_change
from .given_views import check_poses, checked_names, checked_picture
from .journal import Journal
from .known_facts import constraint_of
from .model_building import build_model, checked_loop, problems_of
from .owner_lock import OwnerLock
from .proposals import Proposals
from .view_geometry import PointEstimate, ViewGeometry


class ModelSession:
    """Views with pictures, clicks, and the object model that they make.

    Every change is on the disk before the call returns, in a journal beside the model's file; a
    session that is opened on the same file again goes on where the last one ended, however it
    ended. A call that raises leaves the session as it was.

    Attributes:
        names: of the views, in their order.
        pictures: grey pictures by view.
        calibration: of the camera that took them.
        path: of the model's file; None for a session that is kept in memory only.
        document: what the person has made.
        geometry: where points and curves are.
        notes: sentences on what happened when the session was opened.
        proposals: points and edges that are offered and not decided yet.
    """

    def __init__(
        self,
        calibration: Calibration,
        base_from_tool: Float[np.ndarray, "views 4 4"],
        pictures: Sequence[np.ndarray | str | os.PathLike[str]],
        names: Sequence[str] | None = None,
        path: str | os.PathLike[str] | None = None,
        covariance: CalibrationEstimate | None = None,
        click_sigma: float = 0.5,
    ):
        """Open a session; with the journal of an earlier one, go on where that ended.

        Args:
            calibration: of the camera; the model is in its world frame.
            base_from_tool: what the robot reported in each view.
            pictures: a file, or a picture as grey or BGR uint8, for each view.
            names: of the views; by default v1, v2, ...
            path: of the model's file, a .json; None keeps nothing on disk.
            covariance: a joint fit that says how well the calibration is known; None takes it as
                exact.
            click_sigma: standard deviation of u and of v of a click, px.

        Raises:
            ValueError: fewer than two views, poses that are not rigid, pictures of another size
                than the camera's, names that come twice, a journal of other views, or a model file
                without a journal, which the session would overwrite.
            FileNotFoundError: a picture is missing.
            BlockingIOError: the file is open in another editor, which the message names.
        """
        # Everything that is given is checked before a lock or a file is made.
        self.names = checked_names(names, len(pictures))
        check_poses(np.asarray(base_from_tool, dtype=float), self.names)
        size = calibration.camera.image_size
        self.pictures = {
            name: checked_picture(picture, name, size)
            for name, picture in zip(self.names, pictures, strict=True)
        }
        self.calibration, self.notes = calibration, []
        self.geometry = ViewGeometry(
            calibration, base_from_tool, self.names, covariance, click_sigma
        )
        self.document = Document()
        # Documents share what they have in common, so that keeping all of them costs little.
        self._history: list[Document] = [self.document]
        self._position = 0
        self._saved: Document | None = None
        self._features: dict[str, Features] = {}
        self._refinement: tuple[tuple, dict, dict] | None = None
        self._finding = {name: threading.Lock() for name in self.names}
        self._covariance = covariance
        self.proposals = Proposals(None, self.names, self.document)
        # Rounded, because the same poses read from two formats differ in the last digit.
        self._reported = [np.asarray(pose).round(9).tolist() for pose in base_from_tool]
        self.path = None if path is None else Path(path)
        self._lock: OwnerLock | None = None
        self._journal: Journal | None = None
        if self.path is not None:
            self._open_journal(self.path)

    def _open_journal(self, path: Path) -> None:
        """Take the file's lock and repeat the changes of its journal."""
        journal_path = path.with_name(path.name + ".journal")
        if path.is_file() and not journal_path.is_file():
            raise ValueError(
                f"{path} exists, and its journal {journal_path.name} does not: the clicks that it "
                "was made from are gone, so it cannot be edited; choose another file"
            )
        # The lock comes first: a second editor must not even read a journal that is being written.
        self._lock = OwnerLock(path.with_name(path.name + ".lock"))
        try:
            header = {"views": self.names, "base_from_tool": self._reported}
            self._journal = Journal(journal_path, header)
            for number, entry in enumerate(self._journal.entries, start=2):
                # A line that was accepted once is accepted again, unless someone edited the file.
                try:
                    self._apply(entry)
                except ValueError as error:
                    raise ValueError(f"{journal_path}: line {number}: {error}") from None
        # Or a session that could not be opened would keep others from opening it.
        except BaseException:
            self.close()
            raise
        if self._journal.cut_off:
            self.notes.append(
                f"the last change was torn ({self._journal.cut_off} bytes) and is cut off"
            )

    def _apply(self, entry: Mapping[str, Any]) -> None:
        """Change the session in memory by one entry of the journal."""
        if "undo" in entry:
            self._position = max(self._position - 1, 0)
        elif "redo" in entry:
            self._position = min(self._position + 1, len(self._history) - 1)
        elif "saved" in entry:
            self._saved = self.document
        else:
            changed = apply_change(self.document, entry)
            # A new change ends what could be redone.
            self._history[self._position + 1 :] = [changed]
            self._position += 1
        self.document = self._history[self._position]

    def change(self, change: Mapping[str, Any]) -> None:
        """Make one change, as `document.apply_change` describes it, and keep it on disk.

        Raises:
            ValueError: the change is not possible; nothing was changed.
            OSError: it cannot be written; nothing was changed.
        """
        self._check_clicks(change)
        changed = apply_change(self.document, change)
        # Everything that can fail is tried before the journal has the change.
        self.estimates(changed)
        self._write(change)
        self._history[self._position + 1 :] = [changed]
        self._position += 1
        self.document = changed

    def _write(self, entry: Mapping[str, Any]) -> None:
        """Append an entry to the journal, if the session has a file."""
        if self._journal is not None:
            self._journal.append(entry)

    def _check_clicks(self, change: Mapping[str, Any]) -> None:
        """Raise an error for a click in an unknown view or outside of its picture."""
        # A change of several parts is checked as a whole before any of it is made.
        clicks = dict(change.get("clicks") or {})
        if change.get("do") == "click":
            clicks[change.get("view")] = change.get("pixel")
        for view, pixel in clicks.items():
            self.checked_pixel(view, pixel)
        for part in change.get("changes") or ():
            self._check_clicks(part)

    def checked_pixel(self, view: Any, pixel: Any) -> tuple[float, float]:
        """Return a pixel of a view, or raise an error that names both."""
        if view not in self.pictures:
            raise ValueError(f"there is no view {view!r}; the views are {', '.join(self.names)}")
        try:
            u, v = (float(number) for number in pixel)
        except (TypeError, ValueError):
            raise ValueError(f"view {view}: a pixel is two numbers; found {pixel!r}") from None
        width, height = self.calibration.camera.image_size
        # NaN fails the comparison, too.
        if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
            raise ValueError(
                f"view {view}: the click ({u:g}, {v:g}) is outside of the picture of "
                f"{width} x {height} px"
            )
        return u, v

    def click(self, view: str, pixel: Sequence[float], point: int | None = None) -> int:
        """Click a feature in a view, and return the id of its point.

        Args:
            view: name of the view.
            pixel: u and v, px.
            point: the point that this is a further click of; None for a new point.
        """
        u, v = self.checked_pixel(view, pixel)
        if point is None:
            # Ids are given in order.
            number = self.document.next_id
            self.change({"do": "add_point", "clicks": {view: [u, v]}})
            return number
        self.change({"do": "click", "point": point, "view": view, "pixel": [u, v]})
        return point

    def add_edge(self, a: int, b: int) -> int:
        """Draw an edge between two points, and return its id."""
        number = self.document.next_id
        self.change({"do": "add_edge", "ends": [a, b]})
        return number

    def add_face(self, loop: Sequence[int], name: str = "", graspable: bool | None = None) -> int:
        """Draw a face around points, and return its id; its normal is towards the cameras.

        Raises:
            ValueError: a point without a position, or a face that is not planar or crosses itself.
        """
        # The journal gets the loop as it was turned, so that repeating it needs no geometry.
        outward = checked_loop(loop, self.document, self.estimates(), self.geometry)
        number = self.document.next_id
        self.change({"do": "add_face", "loop": list(outward), "name": name, "graspable": graspable})
        return number

    def add_grasp(self, face: int, **values: Any) -> int:
        """Place a grasp on a face, and return its id; `PlacedGrasp` lists the values."""
        number = self.document.next_id
        change = {"do": "add_grasp", "face": face, **values}
        self._check_grasps(apply_change(self.document, change), number)
        self.change(change)
        return number

    def change_grasp(self, grasp: int, **values: Any) -> None:
        """Move, turn, open or rename a grasp."""
        change = {"do": "change_grasp", "id": grasp, **values}
        self._check_grasps(apply_change(self.document, change), grasp)
        self.change(change)

    def _check_grasps(self, document: Document, grasp: int) -> None:
        """Raise an error if a grasp cannot be made on its face as it is now."""
        # Other grasps may have problems of their own, which are no reason to refuse this one.
        only = dataclasses.replace(document, grasps={grasp: document.existing("grasps", grasp)})
        reason = problems_of(only, self.estimates(only)).get(("grasps", grasp))
        if reason is not None:
            raise ValueError(f"grasp: {reason}")

    def delete(self, kind: str, number: int) -> None:
        """Delete a point, an edge, a face, a grasp or a constraint, and what needs it."""
        self.change({"do": "delete", "kind": kind, "id": number})

    def undo(self) -> bool:
        """Take back the last change; return whether there was one."""
        if self._position == 0:
            return False
        self._write({"undo": True})
        self._apply({"undo": True})
        return True

    def redo(self) -> bool:
        """Make the change again that was taken back last; return whether there was one."""
        if self._position == len(self._history) - 1:
            return False
        self._write({"redo": True})
        self._apply({"redo": True})
        return True

    @property
    def can_undo(self) -> bool:
        """Whether there is a change to take back."""
        return self._position > 0

    @property
    def can_redo(self) -> bool:
        """Whether there is a change to make again."""
        return self._position < len(self._history) - 1

    @property
    def is_saved(self) -> bool:
        """Whether the model's file has all changes; the journal has them in any case."""
        return self._saved is not None and self._saved is self.document

    def estimates(self, document: Document | None = None) -> dict[int, PointEstimate]:
        """Return where all points are, by id."""
        document = document or self.document
        points = document.points
        if document.constraints:
            return self._refined(document)[0]
        found = self.geometry.estimates(list(points.values()))
        return dict(zip(points, found, strict=True))

    def verdicts(self) -> dict[int, ConstraintVerdict]:
        """Return how each constraint agrees with the pictures and the others, by id."""
        return self._refined(self.document)[1] if self.document.constraints else {}

    def _refined(
        self, document: Document
    ) -> tuple[dict[int, PointEstimate], dict[int, ConstraintVerdict]]:
        """Return points and verdicts of a document with constraints, refined together."""
        made_from = (document.points, document.constraints)
        # The same objects mean the same answer; a document shares what a change left alone.
        if self._refinement is None or not all(map(operator.is_, self._refinement[0], made_from)):
            number = {point: k for k, point in enumerate(document.points)}
            constraints = [constraint_of(fact, number) for fact in document.constraints.values()]
            points = list(document.points.values())
            found, verdicts = self.geometry.refined(points, constraints)
            named = dict(zip(document.points, found, strict=True))
            judged = dict(zip(document.constraints, verdicts, strict=True))
            self._refinement = (made_from, named, judged)
        return self._refinement[1], self._refinement[2]

    def curves(self, view: str, pixel: Sequence[float]) -> dict[str, EpipolarCurve]:
        """Return the epipolar curves of a pixel in all other views, by the view's name."""
        return self.geometry.curves(view, self.checked_pixel(view, pixel))

    def features(self, view: str) -> Features:
        """Return the corners and segments found in a view's picture, which clicks snap to."""
        # The page asks for them while a server's thread prepares them: one waits for the other.
        with self._finding[view]:
            if view not in self._features:
                camera = self.calibration.camera
                self._features[view] = find_features(self.pictures[view], camera)
        return self._features[view]

    def propose(self) -> Proposals:
        """Match the corners of all views by themselves, and offer the points and edges found.

        The offer is not part of the session's file; what is accepted of it is.
        """
        # Features were found for snapping; they are not searched for again.
        found = propose_model(
            self.calibration,
            self.geometry.base_from_tool,
            list(self.pictures.values()),
            self.geometry.common_depths,
            features=[self.features(name) for name in self.names],
            covariance=self._covariance,
        )
        self.proposals = Proposals(found, self.names, self.document)
        return self.proposals

    def accept(self, numbers: Sequence[int]) -> None:
        """Add proposed points to the model, with the edges between what is there then."""
        before = self.document
        self.change(self.proposals.accepted(numbers, before))
        self.proposals.decide(numbers, before)

    def reject(self, numbers: Sequence[int]) -> None:
        """Take proposed points from the offer."""
        self.proposals.decide(numbers, None)

    def problems(self) -> dict[tuple[str, int], str]:
        """Return what is not part of the model yet and why, by kind and id."""
        return problems_of(self.document, self.estimates())

    def distance(self, a: int, b: int) -> tuple[float, float]:
        """Return the distance of two points and its standard deviation, m."""
        estimates = self.estimates()
        for point in (a, b):
            self.document.existing("points", point)
            if estimates[point].failure:
                raise ValueError(f"point {point} has no position: {estimates[point].failure}")
        return estimates[a].distance_to(estimates[b])

    def model(self, document: Document | None = None) -> ObjectModel:
        """Return the object model of everything that has a position."""
        document = document or self.document
        return build_model(document, self.estimates(document), self.names)

    def save(self, path: str | os.PathLike[str] | None = None) -> Path:
        """Write the model as JSON, completely or not at all.

        Raises:
            ValueError: the session has no file and none is given, or nothing has a position yet.
        """
        target = self.path if path is None else Path(path)
        if target is None:
            raise ValueError("save: this session has no file; give a path")
        model = self.model()
        if not len(model.vertices):
            raise ValueError("save: no point has a position yet; click each in two views")
        written = save_object_model(model, target)
        # A copy elsewhere does not make this file saved.
        if target == self.path:
            self._write({"saved": target.name})
            self._saved = self.document
        return written

    def close(self) -> None:
        """Let go of the file, so that another editor can open it."""
        if self._journal is not None:
            self._journal.close()
            self._journal = None
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def __enter__(self) -> "ModelSession":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def prepare(self) -> None:
        """Compile what the first clicks need, and find the features of all pictures."""
        width, height = self.calibration.camera.image_size
        # Any pixel will do: the first call of each program is the slow one.
        middle = (0.5 * width, 0.5 * height)
        self.geometry.estimates([dict.fromkeys(self.names, middle)])
        self.geometry.curves(self.names[0], middle)
        self.geometry.pixels_of(np.zeros((1, 3)))
        for name in self.names:
            # A picture without features can still be clicked; whoever asks for them is told why.
            with contextlib.suppress(ValueError):
                self.features(name)
