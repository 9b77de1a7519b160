"""Change a document as a person does: clicks, edges, faces and grasps, undo and redo."""

import abc
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .click_checks import check_clicks, checked_pixel
from .document import Document, apply_change
from .edit_history import EditHistory
from .model_building import checked_loop, problems_of
from .view_geometry import PointEstimate, ViewGeometry


class AbstractDrawing(abc.ABC):
    """A document that is drawn step by step, each of which is checked before it is kept.

    Attributes:
        names: of the views, in their order.
        geometry: where points and curves are.
    """

    names: list[str]
    geometry: ViewGeometry
    _journal: EditHistory

    @property
    @abc.abstractmethod
    def picture_size(self) -> tuple[int, int]:
        """Width and height of the pictures, px."""

    @abc.abstractmethod
    def estimates(self, document: Document | None = None) -> dict[int, PointEstimate]:
        """Return where all points are, by id."""

    @property
    def document(self) -> Document:
        """Return what the person has made."""
        return self._journal.document

    def change(self, change: Mapping[str, Any]) -> None:
        """Make one change, as `document.apply_change` describes it, and keep it on disk.

        Raises:
            ValueError: the change is not possible; nothing was changed.
            OSError: it cannot be written; nothing was changed.
        """
        # Clicks first: the document knows neither the views nor the size of their pictures.
        check_clicks(change, self.names, self.picture_size)
        changed = apply_change(self.document, change)
        # Everything that a page shows is tried on the copy before the journal has the change: what
        # fails only afterwards would fail again whenever the file is opened.
        try:
            problems_of(changed, self.estimates(changed))
        except ValueError:
            raise
        except Exception as error:
            raise ValueError(
                f"{change.get('do')}: the geometry cannot be computed: {error}"
            ) from error
        self._journal.change(change, changed)

    def checked_pixel(self, view: Any, pixel: Any) -> tuple[float, float]:
        """Return a pixel of a view, or raise an error that names both."""
        return checked_pixel(view, pixel, self.names, self.picture_size)

    def click(
        self, view: str, pixel: Sequence[float] | np.ndarray, point: int | None = None
    ) -> int:
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
        # Tried on a copy: only what can be gripped is journalled.
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
        return self._journal.undo()

    def redo(self) -> bool:
        """Make the change again that was taken back last; return whether there was one."""
        return self._journal.redo()

    @property
    def can_undo(self) -> bool:
        """Whether there is a change to take back."""
        return self._journal.can_undo

    @property
    def can_redo(self) -> bool:
        """Whether there is a change to make again."""
        return self._journal.can_redo

    @property
    def is_saved(self) -> bool:
        """Whether the model's file has all changes; the journal has them in any case."""
        return self._journal.is_saved
