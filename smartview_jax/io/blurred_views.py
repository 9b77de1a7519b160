"""Say in words that pictures of a target are blurred: all of them, or some more than the others."""

from collections.abc import Mapping

import numpy as np

from ..argument_checks import listed
from ..detection import Detection

MAX_WIDTH = 4.8
"""Largest width of a target's edges that needs no remark, px.

A pixel and a good lens make an edge 1.2 px wide. A picture with edges four times as wide shows no
more than a sharp one of a quarter of its width and height.
"""

MAX_RATIO = 2.0
"""Largest ratio of the width of a view's edges to the median view's that needs no remark.

Where the target is nearer, farther or more inclined in some views, a lens blurs them more.
"""


def blur_notes(detections: Mapping[str, Detection]) -> tuple[str, ...]:
    """Return sentences about blurred pictures, by how wide the target's edges are in each view."""
    widths = {view: d.edge_width for view, d in detections.items() if d.edge_width is not None}
    # Pictures in which the target was not found may show anything.
    found = [view for view in widths if detections[view].visible.any()]
    if not found:
        return ()
    usual = float(np.median([widths[view] for view in found]))
    notes = []
    if usual > MAX_WIDTH:
        scatters = [detections[view].noise for view in found if detections[view].noise > 0.0]
        scatter = (
            f", and its points scatter by {np.median(scatters):.2g} px (there 0.05 to 0.2 px)"
            if scatters
            else ""
        )
        notes.append(
            f"the pictures are blurred: the target's edges are {usual:.2g} px wide (in sharp "
            f"pictures 1 to 3 px){scatter}. Focus the lens, expose for a shorter time, and let the "
            "arm stand still for each picture"
        )
    blurred = [view for view, w in widths.items() if w > max(MAX_WIDTH, MAX_RATIO * usual)]
    if blurred:
        widest = max(widths[view] for view in blurred)
        several = len(blurred) > 1
        notes.append(
            f"view{'s' * several} {listed(blurred)}: far more blurred than the others: "
            f"edges are {'up to ' * several}{widest:.2g} px wide there, and {usual:.2g} px in the "
            "median view. Did the arm still move, or is the target out of focus there?"
        )
    return tuple(notes)
