"""Find the symmetry of a drawn object, and what the person has said of it."""

import dataclasses
import operator

import numpy as np

from ..modeling import ObjectModel, Symmetry, find_symmetry
from .document import Document


class StatedSymmetry:
    """The symmetry of documents' models; what was found last is kept, as it may take long."""

    def __init__(self):
        """Begin with nothing found."""
        self._last: tuple[tuple, Symmetry | None] | None = None

    def found(self, document: Document, model: ObjectModel) -> Symmetry | None:
        """Return the symmetry of a document's model, or None where it cannot have a finite one."""
        made_from = (document.points, document.edges, document.faces, document.constraints)
        # The same objects mean the same answer; a document shares what a change left alone.
        last = self._last
        if last is None or not all(map(operator.is_, last[0], made_from)):
            try:
                found = find_symmetry(model) if len(model.vertices) > 2 else None
            # Vertices on one line: while somebody clicks that is no error, only too early.
            except ValueError:
                found = None
            self._last = last = (made_from, found)
        return last[1]

    def said(self, document: Document, model: ObjectModel) -> bool | None:
        """Return whether the person has confirmed (or refused) the symmetry that is found now."""
        found = self.found(document, model)
        # What was said of four turns says nothing of the two that are left after an edit.
        if found is None or document.symmetry_order not in (None, found.order):
            return None
        return document.symmetry_confirmed

    def stated(self, document: Document, model: ObjectModel) -> Symmetry | None:
        """Return the symmetry for the model's file; None where the person has said nothing of it.

        A symmetry that was refused is the group of one turn: the person has confirmed that all
        poses can be told apart, for example by a label.
        """
        found, said = self.found(document, model), self.said(document, model)
        if found is None or said is None:
            return None
        if said:
            return dataclasses.replace(found, confirmed=True)
        return Symmetry(np.eye(3)[None], found.centre, None, True)
