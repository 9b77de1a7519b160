"""Define the entry `target`, the calibration target in the pictures, in metres."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from .entry import Coordinate, Entry, Expected, Flag, Length, PrintableText, Translation

_Count = Annotated[int, Field(ge=1, le=1000), Expected("a whole number from 1 to 1000")]
_Heights = Annotated[
    list[Coordinate],
    Field(min_length=1, max_length=1000),
    Expected("heights of the board under one viewpoint, m: a list of 1 to 1000 numbers"),
]

_TagNumber = Annotated[int, Field(ge=0, le=10_000), Expected("a tag's number, 0 to 10000")]
_BorderBits = Annotated[
    int, Field(ge=1, le=5), Expected("the width of a tag's border in cells, 1 to 5")
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
    dictionary: PrintableText = "DICT_4X4_250"
    legacy: Flag = False
    heights: _Heights | None = None


class TagGridEntry(Entry):
    """Square markers in rows; see `targets.TagGrid`."""

    kind: Literal["tag_grid"]
    rows: _Count
    columns: _Count
    size: Length
    gap: Annotated[float, Field(ge=0.0, le=100.0), Expected("a gap in m, from 0 to 100")] | None = (
        None
    )
    dictionary: PrintableText = "DICT_APRILTAG_36h11"
    first_id: _TagNumber = 0
    border_bits: _BorderBits = 1
    rows_from: Literal["top", "bottom"] = "top"
    heights: _Heights | None = None


class AprilGridEntry(Entry):
    """An AprilGrid of Kalibr; see `targets.AprilGrid`.

    Its numbers are given here, or in Kalibr's own file: `{kind: aprilgrid, file: target.yaml}`.
    """

    kind: Literal["aprilgrid"]
    file: PrintableText | None = None
    rows: _Count | None = None
    columns: _Count | None = None
    size: Length | None = None
    spacing: (
        Annotated[float, Field(gt=0.0, lt=1.0), Expected("a fraction of a tag's side, 0 to 1")]
        | None
    ) = None
    dictionary: PrintableText = "DICT_APRILTAG_36h11"
    first_id: _TagNumber = 0
    border_bits: _BorderBits = 2
    heights: _Heights | None = None

    @model_validator(mode="after")
    def _check_source(self) -> "AprilGridEntry":
        numbers = ("rows", "columns", "size", "spacing")
        given = [name for name in numbers if getattr(self, name) is not None]
        if self.file is not None and given:
            raise ValueError(f"{', '.join(given)}: already stated in the file {self.file}")
        if self.file is None and len(given) < len(numbers):
            missing = [name for name in numbers if name not in given]
            raise ValueError(f"an aprilgrid needs {', '.join(missing)}, or the entry file")
        return self


class PointsEntry(Entry):
    """Points given one by one; see `targets.ListedPoints`."""

    kind: Literal["points"]
    coordinates: Annotated[
        list[Translation],
        Field(min_length=1, max_length=100_000),
        Expected("the points, m: a list of [x, y, z]"),
    ]


TargetEntry = Annotated[
    CircleGridEntry | ChessboardEntry | CharucoEntry | TagGridEntry | AprilGridEntry | PointsEntry,
    Field(discriminator="kind"),
]
