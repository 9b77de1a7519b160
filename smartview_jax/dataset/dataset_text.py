"""Describe a data set in a few lines, for `print(data)`."""

from typing import TYPE_CHECKING

import numpy as np
from jaxlie import SE3

from ..geometry import vector_text

if TYPE_CHECKING:
    from .dataset import Dataset

LISTED_LINES = 2
"""Most lines about masked views, and about notes; the text then has ten lines at most."""

TARGET_LENGTH = 80
"""Most characters of the target's description that are shown."""

LISTED_NAMES = 10
"""Most names of views that are shown."""


def dataset_text(data: "Dataset") -> str:
    """Return what a data set contains, in at most ten lines."""
    masked = len(data.masked_views)
    views = f"{data.view_count} views" + (f" ({masked} of them not used)" if masked else "")
    width, height = data.image_size
    # Tracked poses have no picture.
    picture = f", {width} x {height} px" if width else ""
    lines = [f"<{data.mount} data set: {views}{picture}", _points_line(data), _robot_line(data)]
    if data.target is not None:
        lines.append(f"target: {_start(repr(data.target))}")
    lines.append(f"names of the views: {_names(data.view_ids)}")
    lines += _first([f"view {view}: {reason}" for view, reason in data.masked_views])
    lines += _first([f"note: {note}" for note in data.notes])
    return "\n  ".join(" ".join(line.split()) for line in lines) + ">"


def _points_line(data: "Dataset") -> str:
    """Return how many points are seen, in all and in a view."""
    counts = np.asarray(data.visible).sum(axis=1)[data.usable_views(1)]
    if not len(counts):
        return "no points are seen"
    fewest, most = counts.min(), counts.max()
    span = f"{most} in every view" if fewest == most else f"{fewest} to {most} in a view"
    text = f"points: {counts.sum()} seen, {span}"
    if data.depths is None:
        return text
    return f"{text}, {(data.depths.used & np.asarray(data.visible)).sum()} with a depth"


def _robot_line(data: "Dataset") -> str:
    """Return how far the tool moved, and whether joint readings are known."""
    if data.hands is not None:
        spans = (
            _span(data, poses)
            for poses in (data.hands.base_from_tool, data.hands.other_base_from_other_tool)
        )
        return f"two arms: camera over {', target over '.join(spans)}"
    readings = "" if data.joints is None else f", readings of {data.joints.shape[1]} joints"
    if len(data.usable_views(1)) < 2:
        return f"robot: poses{readings}"
    return f"robot: poses over {_span(data, data.base_from_tool)}{readings}"


def _span(data: "Dataset", poses: SE3) -> str:
    """Return how far a hand moved between the views that are used."""
    positions = np.asarray(poses.wxyz_xyz)[data.usable_views(1), 4:]
    extent = np.ptp(positions, axis=0) if len(positions) else np.zeros(3)
    return f"{vector_text(1e3 * extent, 0)} mm"


def _start(text: str) -> str:
    """Return the beginning of a text that would not fit a line."""
    return text if len(text) <= TARGET_LENGTH else f"{text[: TARGET_LENGTH - 3]}..."


def _names(names: tuple[str, ...]) -> str:
    """Return the names, without the middle of a long list."""
    if len(names) <= LISTED_NAMES:
        return ", ".join(names)
    half = LISTED_NAMES // 2
    return f"{', '.join(names[:half])}, ..., {', '.join(names[-half:])}"


def _first(sentences: list[str]) -> list[str]:
    """Return the first sentences, and how many more there are."""
    if len(sentences) <= LISTED_LINES:
        return sentences
    # How many more there are is said at the end of the last line.
    *first, last = sentences[:LISTED_LINES]
    return [*first, f"{last} (and {len(sentences) - LISTED_LINES} more)"]
