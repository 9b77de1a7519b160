"""Define the entry `target`, the calibration target in the pictures, in metres."""

from typing import Annotated, Literal

from pydantic import Field

from .entry import Coordinate, Entry, Expected, Flag, Length, Name

_Count = Annotated[int, Field(ge=1, le=1000), Expected("a whole number from 1 to 1000")]
_Heights = Annotated[
    list[Coordinate],
    Field(min_length=1, max_length=1000),
    Expected("heights of the board under one viewpoint, m: a list of 1 to 1000 numbers"),
]


class CircleGridEntry(Entry):
    """Circles in rows; see `targets.CircleGrid`."""

    kind: Literal["circle_grid"]
    rows: _Count
    columns: _Count
    spacing: Length
    asymmetric: Flag = False
    light_on_dark: Flag = False
    origin_mark: Flag = False
    radius: Length | None = None
    mark_radius: Length | None = None
    heights: _Heights | None = None


class ChessboardEntry(Entry):
    """Inner corners in rows; see `targets.Chessboard`."""

    kind: Literal["chessboard"]
    rows: _Count
    columns: _Count
    square: Length
    heights: _Heights | None = None


class CharucoEntry(Entry):
    """A chessboard with markers; see `targets.Charuco`."""

    kind: Literal["charuco"]
    squares_x: _Count
    squares_y: _Count
    square: Length
    marker: Length
    dictionary: Name = "DICT_4X4_250"
    legacy: Flag = False
    heights: _Heights | None = None


class TagGridEntry(Entry):
    """Square markers in rows; see `targets.TagGrid`."""

    kind: Literal["tag_grid"]
    rows: _Count
    columns: _Count
    size: Length
    gap: Annotated[float, Field(ge=0.0, le=100.0), Expected("a gap in m, from 0 to 100")] = 0.0
    dictionary: Name = "DICT_APRILTAG_36h11"
    first_id: Annotated[int, Field(ge=0, le=10_000), Expected("a tag's number, 0 to 10000")] = 0
    heights: _Heights | None = None


TargetEntry = Annotated[
    CircleGridEntry | ChessboardEntry | CharucoEntry | TagGridEntry, Field(discriminator="kind")
]
