"""Ask of every face of an object whether the pictures show where it ends.

Another solid has much in common with a model that is not there: a block has the right angles of a
box at each of its corners, and often some of its lengths. A pose at such a corner fits exactly, as
far as that block agrees. What gives it away is the face that is not where the model has it: next to
nothing of the face's edges is in any picture. Something that hides a part of an object seldom hides
all edges of one of its faces, in all views.
"""

import numpy as np

from .edge_lines import EdgeLines
from .wireframe import Wireframe

EXACT_PX = 0.5
"""Largest distance of an edge from the model's, px, that confirms the faces beside it."""

CONFIRMED_SHARE = 0.15
"""Part of the visible edges of a face that has to be found.

One short edge of a face may lie on an edge of something else, by chance, in all views. All between
0.10 and 0.16 decide 380 right poses and 235 wrong ones at other solids alike, but for two.
"""


def largest_unconfirmed_face(lines: EdgeLines, wireframe: Wireframe) -> float:
    """Return the size of the largest face whose edges are not found, by their visible length.

    Each edge counts for both faces that it bounds. Edges behind other known objects are not visible
    and do not count.

    Args:
        lines: edges measured at the pose, in all views.
        wireframe: of the model.

    Returns:
        The visible length of the face's edges over that of all edges, all views together; zero if
        every face is confirmed; NaN for a model without faces, which nothing can confirm.
    """
    edge_faces = np.asarray(wireframe.edge_faces).astype(float)
    if not edge_faces.any():
        return np.nan
    is_exact = lines.measured & (np.linalg.norm(lines.offsets, axis=2) <= EXACT_PX)
    visible = lines.visible_px.sum(axis=0) @ edge_faces
    found = np.where(is_exact, lines.explained_px, 0.0).sum(axis=0) @ edge_faces
    unconfirmed = np.where(found < CONFIRMED_SHARE * visible, visible, 0.0)
    return float(unconfirmed.max() / max(float(lines.visible_px.sum()), 1.0))
