"""Define Kalibr's AprilGrid: tags with a wide border, and black squares between their corners."""

import dataclasses
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from .marker_dictionaries import require_markers
from .target import AbstractTarget, require_count, require_positive


@dataclasses.dataclass(frozen=True)
class AprilGrid(AbstractTarget):
    """An AprilGrid as Kalibr prints it, whose points are the four corners of each tag.

    Tags are numbered row by row from the bottom left. The corners of a tag are counted as Kalibr's
    detector does: bottom left, bottom right, top right, top left. The frame is Kalibr's: its origin
    is the bottom left corner of the first tag, with x to the right, y up and z out of the board. A
    view may show only some of the tags.

    Attributes:
        rows, columns: number of tags up and across (Kalibr's `tagRows`, `tagCols`).
        size: side of a tag's black square, m (`tagSize`).
        spacing: distance between the black squares of neighbouring tags as a fraction of their
            side (`tagSpacing`).
        dictionary: name of an OpenCV dictionary; Kalibr's is `"DICT_APRILTAG_36h11"`.
        first_id: number of the bottom left tag.
        border_bits: width of a tag's black border in cells of its code; Kalibr's is 2.
    """

    rows: int
    columns: int
    size: float
    spacing: float
    dictionary: str = "DICT_APRILTAG_36h11"
    first_id: int = 0
    border_bits: int = 2

    y_up: ClassVar[bool] = True
    lengths: ClassVar[tuple[str, ...]] = ("size",)
    corner_order: ClassVar[tuple[int, int, int, int]] = (1, 0, 3, 2)
    """Index in this class of the corners of a tag in OpenCV's order.

    Kalibr prints every tag rotated by 180 degrees relative to OpenCV's drawing.
    """

    def __post_init__(self) -> None:
        """Raise a ValueError that names the first attribute that is wrong."""
        require_count(1, rows=self.rows, columns=self.columns, border_bits=self.border_bits)
        require_count(0, first_id=self.first_id)
        require_positive(size=self.size)
        if not 0.0 < self.spacing < 1.0:
            raise ValueError(
                "spacing: expected the gap between tags as a fraction of their side, between 0 and "
                f"1; found {self.spacing!r}"
            )
        require_markers(self.dictionary, self.ids[-1])

    @property
    def ids(self) -> range:
        """The numbers of the tags, row by row from the bottom."""
        return range(self.first_id, self.first_id + self.rows * self.columns)

    @property
    def points(self) -> Float[np.ndarray, "points 3"]:
        """The four corners of every tag, tags row by row from the bottom left, m."""
        i, j = np.mgrid[0 : self.rows, 0 : self.columns]
        origins = np.stack([j, i], axis=-1).reshape(-1, 1, 2) * (1.0 + self.spacing)
        corners = origins + np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        flat = self.size * corners.reshape(-1, 2)
        return np.column_stack([flat, np.zeros(len(flat))])
