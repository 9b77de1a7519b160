"""Find the symmetry of a drawn object, and whether the user confirmed it."""

import dataclasses
import operator

import numpy as np

from ..modeling import ObjectModel, Symmetry, find_symmetry
from .document import Document


class StatedSymmetry:
    """The symmetry of documents' models; the last result is kept, because it may take long."""

    def __init__(self):
        """Begin with nothing found."""
        self._last: tuple[tuple, Symmetry | None] | None = None

    def found(self, document: Document, model: ObjectModel) -> Symmetry | None:
        """Return the symmetry of a document's model, or None without three vertices in a plane."""
        made_from = (document.points, document.edges, document.faces, document.constraints)
        # Documents share the parts that a change left alone, so identical parts mean the same
        # result.
        last = self._last
        if last is None or not all(map(operator.is_, last[0], made_from)):
            try:
                symmetry = find_symmetry(model) if len(model.vertices) > 2 else None
            # All vertices are on a line: it is too early.
            except ValueError:
                symmetry = None
            self._last = last = (made_from, symmetry)
        return last[1]

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
