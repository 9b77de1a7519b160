"""Define targets that are grids of numbered square markers: AprilTag and ArUco."""

import dataclasses
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from .marker_dictionaries import require_markers
from .target import AbstractTarget, require_count, require_positive


@dataclasses.dataclass(frozen=True)
class TagGrid(AbstractTarget):
    """A grid of numbered tags whose points are the four corners of each tag, tags row by row.

    A view may show only some of the tags. The corners of a tag are in OpenCV's order: top left, top
    right, bottom right, bottom left of the upright tag. The origin is the middle of the grid, with
    x to the right, y *up* and z out of the board, which for a single tag is the usual tag frame.

    Attributes:
        rows, columns: number of tags down and across.
        size: side of a tag's black square, m.
        gap: distance between the black squares of neighbouring tags, m; None for a single tag. A
            grid needs a gap, because a tag is only found with white around it.
        dictionary: name of an OpenCV dictionary, such as `"DICT_APRILTAG_36h11"`.
        first_id: number of the first tag; the others follow row by row from the left.
        border_bits: width of a tag's black border in cells of its code.
        rows_from: `"top"` or `"bottom"`, the row in which the numbers begin.
    """

    rows: int
    columns: int
    size: float
    gap: float | None = None
    dictionary: str = "DICT_APRILTAG_36h11"
    first_id: int = 0
    border_bits: int = 1
    rows_from: str = "top"

    y_up: ClassVar[bool] = True
    lengths: ClassVar[tuple[str, ...]] = ("size", "gap")
    corner_order: ClassVar[tuple[int, int, int, int]] = (0, 1, 2, 3)
    """Index in this class of the corners of a tag in OpenCV's order."""

    def __post_init__(self) -> None:
        """Raise a ValueError that names the first attribute that is wrong."""
        require_count(1, rows=self.rows, columns=self.columns, border_bits=self.border_bits)
        require_count(0, first_id=self.first_id)
        require_positive(size=self.size)
        if self.rows * self.columns > 1:
            if not self.gap:
                raise ValueError(
                    f"gap: a grid of {self.rows} x {self.columns} tags needs the distance between "
                    "the black squares of neighbouring tags, in metres; tags that touch are not "
                    "found"
                )
            require_positive(gap=self.gap)
        elif self.gap:
            require_positive(gap=self.gap)
        if self.rows_from not in ("top", "bottom"):
            raise ValueError(f"rows_from: expected top or bottom, found {self.rows_from!r}")
        require_markers(self.dictionary, self.ids[-1])

    @property
    def ids(self) -> range:
        """The numbers of the tags, row by row."""
        return range(self.first_id, self.first_id + self.rows * self.columns)

    @property
    def pitch(self) -> float:
        """The distance between the centres of neighbouring tags, m; the side for a single tag."""
        return self.size + (self.gap or 0.0)

    @property
    def points(self) -> Float[np.ndarray, "points 3"]:
        """The four corners of every tag, tags row by row, m."""
        # Tag j of row i has its centre at x = (j - (columns - 1) / 2) pitch and
        # y = ((rows - 1) / 2 - i) pitch, with rows counted downwards, or the negative: y points up.
        pitch = self.pitch
        i, j = np.mgrid[0 : self.rows, 0 : self.columns]
        x = (j - 0.5 * (self.columns - 1)).ravel() * pitch
        y = (0.5 * (self.rows - 1) - i).ravel() * (pitch if self.rows_from == "top" else -pitch)
        centres = np.stack([x, y, np.zeros_like(x)], axis=-1)
        half = 0.5 * self.size
        corners = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
        return (centres[:, None] + corners[None]).reshape(-1, 3)
