"""Edit an object model: the one class behind the page, the notebook's widget and scripts.

with ModelSession(calibration, poses, pictures, path="bracket.json") as session:
    corner = session.click("v1", (312.4, 201.9))
    session.click("v2", (298.1, 215.0), corner)
    session.save()
"""

import contextlib
import dataclasses
import os
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..argument_checks import errors_at, require_distinct, require_readable
from ..cameras import Camera
from ..detection import read_picture
from ..evaluation import CalibrationEstimate
from ..features import Features
from ..geometry import host_matrices
from ..io import save_object_model
from ..modeling import (
    AnyCalibration,
    ConstraintVerdict,
    EpipolarCurve,
    ObjectModel,
    Region,
    RigViews,
    SeenViews,
    Symmetry,
    as_checked_command,
    command_at,
    propose_model,
)
from ..robots import CommandLike
from .disagreements import Disagreement, Findings, disagreements_of
from .document import KINDS, Document
from .document_estimates import DocumentEstimates
from .drawing import AbstractDrawing, PictureSizes, check_view
from .edit_history import EditHistory
from .kept_results import PictureFeatures, StatedSymmetry
from .model_building import build_model, placed_points, problems_of
from .proposals import Proposals
from .suggestions import Suggestion, suggestions_of
from .view_geometry import PointEstimate, ViewGeometry

MIN_VIEWS = 2
"""Smallest number of views of a session, for triangulation."""


class ModelSession(AbstractDrawing):
    """Views with pictures and clicks, and the object model made from them.

    Every change is on disk before the call returns, in a journal next to the model's file; a
    session opened on the same file resumes where the last one ended, even if it crashed. A call
    that raises leaves the session as it was.

    Attributes:
        names: names of the views, in their order.
        cameras: the camera of each view, by the view's name.
        pictures: grey pictures by view.
        calibration: calibration of the camera, or the cameras of the views.
        path: path of the model's file; None for a session in memory only.
        geometry: geometry of points and curves in the views.
        notes: remarks from the opening of the session.
        proposals: proposed points and edges that are not decided yet.

    For example:

        >>> pictures = [np.full((480, 640), 128, np.uint8)] * data.view_count
        >>> with sv.ModelSession(truth, data.base_from_tool, pictures, data.view_ids) as session:
        ...     session.change({"do": "rename", "name": "gear box"})
        ...     print(session.names[:2], session.document.name)
        ['0', '1'] gear box
    """

    def __init__(
        self,
        calibration: AnyCalibration,
        poses: CommandLike | None,
        pictures: Sequence[np.ndarray | str | os.PathLike[str]],
        names: Sequence[str] | None = None,
        path: str | os.PathLike[str] | None = None,
        covariance: CalibrationEstimate | None = None,
        click_sigma: float = 0.5,
    ):
        """Open a session, or resume an earlier one from its journal.

        Args:
            calibration: calibration of the camera; the model is in its world frame. `RigViews` for
                pictures of several cameras.
            poses: reported pose of each view: `base_from_tool`, or a `Command` with joint readings
                if the calibration corrects errors of the arm; None where the robot does not matter
                (`RigViews`).
            pictures: a file, or a picture as grey or BGR uint8, for each view.
            names: names of the views; by default v1, v2, ...
            path: path of the model's file, a .json; None keeps nothing on disk.
            covariance: a joint fit with the covariance of the calibration; None takes the
                calibration as exact.
            click_sigma: standard deviation of u and of v of a click, px.

        Raises:
            ValueError: fewer than two views, poses that are not rigid, pictures of a wrong size,
                repeated names, a journal of other views, or a model file without a journal, which
                the session would overwrite.
            FileNotFoundError: a picture is missing.
            BlockingIOError: the file is open in another editor, which the message names.
        """
        # All arguments are checked before a lock or a file is created.
        self.names: list[str] = checked_names(names, len(pictures))
        # An error in a pose names its view here; it would name a number below.
        given = None if poses is None else as_checked_command(poses, self.names)
        seen = SeenViews.of(calibration, given)
        self.cameras: dict[str, Camera] = dict(zip(self.names, seen.cameras, strict=True))
        self.pictures: dict[str, np.ndarray] = {
            name: checked_picture(picture, name, self.cameras[name].image_size)
            for name, picture in zip(self.names, pictures, strict=True)
        }
        self.calibration = calibration
        command = command_at(seen.command, range(len(self.names))) if given is None else given
        self.geometry: ViewGeometry = ViewGeometry(
            calibration, command, self.names, covariance, click_sigma
        )
        self._estimates = DocumentEstimates(self.geometry)
        self._symmetry = StatedSymmetry()
        self._features = PictureFeatures(self.cameras, self.pictures)
        self._covariance = covariance
        self.path: Path | None = None if path is None else Path(path)
        # Rounded, because the same poses read from two formats differ in the last digit.
        reported = host_matrices(command.base_from_tool).round(9).tolist()
        joints = None if command.joints is None else np.asarray(command.joints).round(9).tolist()
        header = {"views": self.names, "base_from_tool": reported, "joints": joints}
        if isinstance(calibration, RigViews):
            header["cameras"] = list(calibration.cameras)
        self._journal = EditHistory(self.path, header)
        self.notes: list[str] = self._journal.notes
        self.proposals: Proposals = Proposals(None, self.names, self.document)

    def __str__(self) -> str:
        """Describe the session in a few lines: the parts, and what disagrees."""
        document = self.document
        counts = ", ".join(f"{len(getattr(document, kind))} {kind}" for kind in KINDS)
        disagreements = self.disagreements()
        lines = [f"{document.name or 'object'}: {counts}; clicked in {', '.join(self.names)}"]
        lines += [f"{kind[:-1]} {number}: {why}" for (kind, number), why in self.problems().items()]
        return "\n".join([*lines, *map(str, disagreements)])

    @property
    def picture_sizes(self) -> PictureSizes:
        """Width and height of the pictures, px, by the view's name."""
        return {name: camera.image_size for name, camera in self.cameras.items()}

    def estimates(self, document: Document | None = None) -> dict[int, PointEstimate]:
        """Return the estimates of all points, by id."""
        return self._estimates.points(document or self.document)

    def verdicts(self) -> dict[int, ConstraintVerdict]:
        """Return whether each constraint agrees with the pictures and the others, by id."""
        return self._estimates.verdicts(self.document)

    def findings(self) -> Findings:
        """Return the estimates of the present document with and without its constraints."""
        # Other messages of the page may replace the document meanwhile.
        document = self.document
        return Findings(
            document,
            self._estimates.points(document),
            self._estimates.by_clicks_alone(document),
            self._estimates.verdicts(document),
        )

    def disagreements(self) -> list[Disagreement]:
        """Return the points, edges and constraints that disagree, with the click to doubt.

        A point disagrees if its clicks do not meet within their uncertainty and the calibration's;
        a constraint if it costs more than chance explains; an edge if such a constraint gives it
        another length or angle than its clicks do. See `Disagreement`.
        """
        return disagreements_of(self.findings(), self.geometry)

    def suggestions(self) -> list[Suggestion]:
        """Return facts about edges that the data make likely, with their odds, the likeliest first.

        None is applied; `add_constraint(suggestion.kind, suggestion.items)` states one:

            for fact in session.suggestions():
                if fact.kind == "right_angle":
                    session.add_constraint(fact.kind, fact.items)
        """
        return suggestions_of(self.document, self._estimates)

    def curves(self, view: str, pixel: Sequence[float] | np.ndarray) -> dict[str, EpipolarCurve]:
        """Return the epipolar curves of a pixel in all other views, by the view's name."""
        return self.geometry.curves(view, self.checked_pixel(view, pixel))

    def features(self, view: str) -> Features:
        """Return the corners and segments found in a view's picture, which clicks snap to."""
        return self._features.of(view)

    def propose(
        self,
        box: Float[np.ndarray, "2 3"] | Sequence[Sequence[float | int]] | None = None,
        rectangles: Mapping[str, Any] | None = None,
    ) -> Proposals:
        """Match the corners of all views automatically, and offer the points and edges found.

        The offer is not part of the session's file; accepted points are.

        Args:
            box: smallest and largest x, y and z of the object in the world, m; None for no limits.
            rectangles: rectangles around the object by the view's name, px: smallest u and v,
                largest u and v. One view suffices to exclude most clutter; see `Region`.

        Raises:
            ValueError: an unknown view, an empty box or rectangle, or a picture without features.
        """
        for name in rectangles or {}:
            check_view(name, self.names)
        numbers = {self.names.index(name): corners for name, corners in (rectangles or {}).items()}
        region = Region(box, numbers)
        # Checked here too, because `propose_model` knows only the numbers of the views.
        region.check(self.names, np.array(list(self.picture_sizes.values())))
        # The features found for snapping are used again.
        proposal = propose_model(
            self.calibration,
            self.geometry.command,
            list(self.pictures.values()),
            self.geometry.common_depths,
            features=[self.features(name) for name in self.names],
            covariance=self._covariance,
            region=region,
        )
        self.proposals = Proposals(proposal, self.names, self.document)
        return self.proposals

    def accept(self, numbers: Sequence[int]) -> None:
        """Add proposed points to the model, with the edges between them and earlier points."""
        before = self.document
        self.change(self.proposals.accepted(numbers, before))
        self.proposals.decide(numbers, before)

    def reject(self, numbers: Sequence[int]) -> None:
        """Remove proposed points from the offer."""
        self.proposals.decide(numbers, None)

    def problems(self) -> dict[tuple[str, int], str]:
        """Return the incomplete parts, which are not in the model, with reasons, by kind and id."""
        return problems_of(self.document, self.estimates())

    def distance(self, a: int, b: int) -> tuple[float, float]:
        """Return the distance between two points and its standard deviation, m."""
        return self.distances([(a, b)])[0]

    def distances(self, pairs: Sequence[tuple[int, int]]) -> list[tuple[float, float]]:
        """Return the distances of pairs of points and their standard deviations, m.

        The errors of both points are correlated by constraints and the calibration: an error that
        moves both points alike does not change their distance.

        Raises:
            ValueError: a point does not exist or has no position.
        """
        document, estimates = self.document, self.estimates()
        for point in dict.fromkeys(point for pair in pairs for point in pair):
            document.existing("points", point)
            if estimates[point].failure:
                raise ValueError(f"point {point} has no position: {estimates[point].failure}")
        return self._estimates.distances(document, pairs)

    def model(self, document: Document | None = None) -> ObjectModel:
        """Return the object model of all complete parts, with the confirmed or refused symmetry."""
        document = document or self.document
        estimates = self.estimates(document)
        joint = self._estimates.correlations(document, placed_points(document, estimates))
        model = build_model(document, estimates, self.names, joint)
        # The symmetry is not searched for while the user still draws.
        if document.symmetry_confirmed is None:
            return model
        return dataclasses.replace(model, symmetry=self._symmetry.stated(document, model))

    def symmetry(self) -> Symmetry | None:
        """Return the rotations that map the object onto itself, for the user to confirm or refuse.

        Returns:
            The group found from vertices, edges and faces, `confirmed` if the user confirmed it;
            None without three vertices that span a plane.
        """
        # Other messages of the page may replace the document meanwhile.
        document = self.document
        model = self.model(document)
        group = self._symmetry.found(document, model)
        if group is None:
            return None
        return dataclasses.replace(group, confirmed=bool(self._symmetry.said(document, model)))

    @property
    def symmetry_said(self) -> bool | None:
        """Whether the present symmetry was confirmed or refused; None if neither."""
        document = self.document
        return self._symmetry.said(document, self.model(document))

    def confirm_symmetry(self, confirmed: bool | None = True) -> None:
        """Confirm the present symmetry, refuse it (False), or withdraw the decision (None).

        A refused symmetry is saved as none: all poses of the object can be told apart. An edit that
        changes the symmetry voids the decision.

        Raises:
            ValueError: there are not yet three vertices that span a plane.
        """
        group = self.symmetry()
        if group is None:
            raise ValueError("symmetry: fewer than three vertices that are not on one line")
        self.change({"do": "confirm_symmetry", "confirmed": confirmed, "order": group.order})

    def save(self, path: str | os.PathLike[str] | None = None) -> Path:
        """Write the model as JSON, completely or not at all.

        The model's provenance lists what disagrees.

        Raises:
            ValueError: the session has no file and none is given, or nothing has a position yet.
        """
        target = self.path if path is None else Path(path)
        if target is None:
            raise ValueError("save: this session has no file; give a path")
        # Built before the file is opened, so that an error leaves the old file alone.
        model = self.model()
        if not len(model.vertices):
            raise ValueError("save: no point has a position yet; click each point in two views")
        doubts = tuple(map(str, self.disagreements()))
        model = dataclasses.replace(model, provenance=model.provenance + doubts)
        written = save_object_model(model, target)
        # A copy elsewhere does not count as saved.
        if target == self.path:
            self._journal.mark_saved(target.name)
        return written

    def close(self) -> None:
        """Release the file, so that another editor can open it."""
        self._journal.close()

    def __enter__(self) -> "ModelSession":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def prepare(self, stop: threading.Event | None = None) -> None:
        """Compile the programs of the first clicks, and find all features, until `stop` is set."""
        # Any pixel will do: only the first call of each program is slow.
        sizes = self.picture_sizes
        middles = {name: (0.5 * width, 0.5 * height) for name, (width, height) in sizes.items()}
        self.geometry.estimates([middles])
        self.geometry.curves(self.names[0], middles[self.names[0]])
        self.geometry.pixels_of(np.zeros((1, 3)))
        for name in self.names:
            if stop is not None and stop.is_set():
                return
            # A picture without features can still be clicked; `features` reports the error.
            with contextlib.suppress(ValueError):
                self.features(name)


def checked_names(names: Sequence[str] | None, count: int) -> list[str]:
    """Return the views' names, or raise an error for too few or repeated names."""
    if count < MIN_VIEWS:
        raise ValueError(f"a session needs at least {MIN_VIEWS} views; found {count}")
    given = [f"v{1 + k}" for k in range(count)] if names is None else [str(name) for name in names]
    if len(given) != count:
        raise ValueError(f"expected a name for each of {count} pictures, found {len(given)}")
    require_distinct("names", given)
    require_readable("names", given)
    return given


def checked_picture(
    picture: np.ndarray | str | os.PathLike[str], name: str, size: tuple[int, int]
) -> np.ndarray:
    """Return a grey picture of the camera's size, or raise an error that names the view."""
    with errors_at(f"view {name}"):
        if not isinstance(picture, np.ndarray):
            return read_picture(Path(picture), size)
        grey = picture.mean(axis=2).astype(np.uint8) if picture.ndim == 3 else picture
        if grey.dtype != np.uint8 or grey.ndim != 2:
            raise ValueError(f"expected uint8, grey or BGR; found {picture.dtype} {picture.shape}")
        if grey.shape[::-1] != size:
            width, height = grey.shape[::-1]
            raise ValueError(
                f"the picture has {width} x {height} px, the camera {size[0]} x {size[1]} px"
            )
        return grey
