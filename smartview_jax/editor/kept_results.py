"""Keep what takes long to compute: the features of pictures, and the symmetry of a drawn object."""

import dataclasses
import operator
import threading
from collections.abc import Callable, Mapping
from typing import Generic, TypeVar

import numpy as np

from ..argument_checks import errors_at
from ..cameras import Camera
from ..features import Features
from ..features import find as find_features
from ..modeling import ObjectModel, Symmetry, find_symmetry
from .document import Document

Result = TypeVar("Result")


def are_same_objects(first: tuple | None, second: tuple) -> bool:
    """Return whether two tuples have identical objects, not only equal ones.

    Documents share the parts that a change left alone, so identical parts mean the same result.
    """
    return first is not None and len(first) == len(second) and all(map(operator.is_, first, second))


class LastResult(Generic[Result]):
    """The last result of a computation, returned again while it depends on the same objects."""

    def __init__(self):
        """Begin without a result."""
        self._last: tuple[tuple, Result] | None = None

    def of(self, made_from: tuple, compute: Callable[[], Result]) -> Result:
        """Return the result of a computation, which is run if it depends on other objects."""
        last = self._last
        if last is None or not are_same_objects(last[0], made_from):
            self._last = last = (made_from, compute())
        return last[1]


class PictureFeatures:
    """The features of a session's pictures, found on first use."""

    def __init__(self, cameras: Mapping[str, Camera], pictures: Mapping[str, np.ndarray]):
        """Take the cameras and the pictures by view."""
        self._cameras, self._pictures = cameras, pictures
        self._found: dict[str, Features] = {}
        self._finding = {name: threading.Lock() for name in pictures}

    def of(self, view: str) -> Features:
        """Return the corners and segments found in a view's picture, which clicks snap to."""
        # A page may ask for them while a thread of the server prepares them.
        with self._finding[view], errors_at(f"view {view}"):
            if view not in self._found:
                self._found[view] = find_features(self._pictures[view], self._cameras[view])
        return self._found[view]


class StatedSymmetry:
    """The symmetry of documents' models, and whether the user confirmed it."""

    def __init__(self):
        """Begin with nothing found."""
        self._last = LastResult[Symmetry | None]()

    def found(self, document: Document, model: ObjectModel) -> Symmetry | None:
        """Return the symmetry of a document's model, or None without three vertices in a plane."""
        made_from = (document.points, document.edges, document.faces, document.constraints)
        return self._last.of(made_from, lambda: _symmetry(model))

    def said(self, document: Document, model: ObjectModel) -> bool | None:
        """Return whether the user confirmed (or refused) the present symmetry; None if neither."""
        symmetry = self.found(document, model)
        # A decision about another symmetry, before an edit, does not count.
        if symmetry is None or document.symmetry_order not in (None, symmetry.order):
            return None
        return document.symmetry_confirmed

    def stated(self, document: Document, model: ObjectModel) -> Symmetry | None:
        """Return the symmetry for the model's file; None if the user has not decided.

        A refused symmetry is the group of the identity alone: the user has confirmed that all poses
        can be told apart, for example by a label.
        """
        symmetry, confirmed = self.found(document, model), self.said(document, model)
        if symmetry is None or confirmed is None:
            return None
        if confirmed:
            return dataclasses.replace(symmetry, confirmed=True)
        return Symmetry(np.eye(3)[None], symmetry.centre, None, True)


def _symmetry(model: ObjectModel) -> Symmetry | None:
    """Return the symmetry of a model, or None while all its vertices are on a line."""
    try:
        return find_symmetry(model) if len(model.vertices) > 2 else None
    except ValueError:
        return None
