"""Describe flat boards by the points that are found on them: corners, circles and markers."""

import dataclasses
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int

from ..argument_checks import require_one_of
from .target import (
    AbstractTarget,
    grid_points,
    grid_symmetries,
    require_count,
    require_flag,
    require_positive,
)

MARKER_COUNTS: dict[str, int] = {
    **{
        f"DICT_{bits}X{bits}_{count}": count
        for bits in (4, 5, 6, 7)
        for count in (50, 100, 250, 1000)
    },
    "DICT_ARUCO_ORIGINAL": 1024,
    "DICT_ARUCO_MIP_36h12": 250,
    "DICT_APRILTAG_16h5": 30,
    "DICT_APRILTAG_25h9": 35,
    "DICT_APRILTAG_36h10": 2320,
    "DICT_APRILTAG_36h11": 587,
}
"""Number of markers in each dictionary, by OpenCV's name for the dictionary.

OpenCV also has the pictures of the markers.
"""


@dataclasses.dataclass(frozen=True)
class Chessboard(AbstractTarget):
    """A chessboard whose points are its inner corners, row by row.

    The order begins where the square between the first four corners is light, if the colours of the
    board allow it. With this condition most boards have only one possible order.

    Attributes:
        rows, columns: number of inner corners down and across.
        square: side of a square, m.
    """

    rows: int
    columns: int
    square: float

    lengths: ClassVar[tuple[str, ...]] = ("square",)

    def __post_init__(self) -> None:
        """Raise a ValueError that names the first attribute that is wrong."""
        require_count(2, rows=self.rows, columns=self.columns)
        require_positive(square=self.square)

    @property
    def points(self) -> Float[np.ndarray, "points 3"]:
        """The inner corners, row by row, m."""
        return grid_points(self.rows, self.columns, self.square)

    @property
    def symmetries(self) -> Int[np.ndarray, "symmetries points"]:
        """The orders of the corners after rotations that map light squares to light squares."""
        # Rotating by 180 degrees displaces the first square by rows + columns - 4 squares, and
        # rotating a square board by 90 degrees by rows - 2; an odd number changes its colour.
        quarter_rotations = (0, 1, 2, 3) if self.rows % 2 == 0 else (0, 2)
        if (self.rows + self.columns) % 2:
            quarter_rotations = (0,)
        return grid_symmetries(self.rows, self.columns, quarter_rotations)


@dataclasses.dataclass(frozen=True)
class Charuco(AbstractTarget):
    """A ChArUco board whose points are its inner chessboard corners, in OpenCV's order.

    A view may show only some of the corners. The frame is OpenCV's: the origin is the board's outer
    corner, so that the first inner corner is at one square in x and in y.

    Attributes:
        squares_x, squares_y: number of squares across and down.
        square, marker: side of a square and of a marker, m.
        dictionary: name of an OpenCV dictionary, such as `"DICT_4X4_250"`.
        legacy: whether the board has the pattern of OpenCV before 4.6, which differs if
            `squares_y` is even: its first square is white.
    """

    squares_x: int
    squares_y: int
    square: float
    marker: float
    dictionary: str = "DICT_4X4_250"
    legacy: bool = False

    lengths: ClassVar[tuple[str, ...]] = ("square", "marker")

    def __post_init__(self) -> None:
        """Raise a ValueError that names the first attribute that is wrong."""
        require_count(2, squares_x=self.squares_x, squares_y=self.squares_y)
        require_positive(square=self.square, marker=self.marker)
        if self.marker >= self.square:
            raise ValueError(
                f"marker: expected a length below the square's {self.square} m, found {self.marker}"
            )
        require_flag(legacy=self.legacy)
        # Every second square (the white ones) has a marker; the numbers begin at zero.
        _require_markers(self.dictionary, self.squares_x * self.squares_y // 2 - 1)

    @property
    def points(self) -> Float[np.ndarray, "points 3"]:
        """The inner corners, row by row, m."""
        inner = grid_points(self.squares_y - 1, self.squares_x - 1, self.square)
        return inner + np.array([self.square, self.square, 0.0])


@dataclasses.dataclass(frozen=True)
class CircleGrid(AbstractTarget):
    """A grid of circles whose points are the circle centres, row by row.

    Attributes:
        rows, columns: number of circles down and across; for an asymmetric grid as OpenCV counts
            them, with every second row shifted by half the distance in a row.
        spacing: distance between neighbours in a row, m; for an asymmetric grid half of this
            distance, which is also the distance between rows (OpenCV's convention).
        asymmetric: whether every second row is shifted.
        light_on_dark: whether the circles are white on black.
        origin_mark: whether one larger corner circle marks the origin (the "modified" grid).
        radius: radius of the circles, m; None if unknown.
        mark_radius: radius of the circle that marks the origin, m; None if unknown.
    """

    rows: int
    columns: int
    spacing: float
    asymmetric: bool = False
    light_on_dark: bool = False
    origin_mark: bool = False
    radius: float | None = None
    mark_radius: float | None = None

    lengths: ClassVar[tuple[str, ...]] = ("spacing", "radius", "mark_radius")

    def __post_init__(self) -> None:
        """Raise a ValueError that names the first attribute that is wrong."""
        require_count(2, rows=self.rows, columns=self.columns)
        require_positive(spacing=self.spacing)
        require_flag(
            asymmetric=self.asymmetric,
            light_on_dark=self.light_on_dark,
            origin_mark=self.origin_mark,
        )
        if self.asymmetric and self.origin_mark:
            raise ValueError("origin_mark: only a symmetric grid has a larger corner circle")
        if self.mark_radius is not None and not self.origin_mark:
            raise ValueError("mark_radius: this grid has no origin_mark")
        # A radius is optional: only the correction of circle centres needs it.
        known = {"radius": self.radius, "mark_radius": self.mark_radius}
        require_positive(**{name: value for name, value in known.items() if value is not None})
        if self.radius is not None and self.radius >= 0.5 * self.nearest_neighbour_distance:
            raise ValueError(
                f"radius: circles {self.nearest_neighbour_distance:g} m apart would touch"
            )

    @property
    def has_known_radii(self) -> bool:
        """Whether the radius of every circle is stated."""
        return self.radius is not None and (self.mark_radius is not None or not self.origin_mark)

    @property
    def nearest_neighbour_distance(self) -> float:
        """The distance between neighbouring centres, m."""
        # In an asymmetric grid the nearest centre is one spacing away in x and in y.
        return self.spacing * (2.0**0.5 if self.asymmetric else 1.0)

    @property
    def points(self) -> Float[np.ndarray, "points 3"]:
        """The circle centres, row by row, m."""
        if not self.asymmetric:
            return grid_points(self.rows, self.columns, self.spacing)
        # Circle j of row i is at (2 j + i mod 2, i), in units of the spacing.
        i, j = np.mgrid[0 : self.rows, 0 : self.columns]
        flat = np.stack([(2 * j + i % 2), i, np.zeros_like(i)], axis=-1)
        return self.spacing * flat.reshape(-1, 3).astype(float)

    @property
    def symmetries(self) -> Int[np.ndarray, "symmetries points"]:
        """The orders of the circles that look the same, the original order first."""
        if self.origin_mark:
            return np.arange(self.rows * self.columns)[None]
        if self.asymmetric:
            # Rotating by 180 degrees maps x to 2 columns - 1 - x and row i to rows - 1 - i. With an
            # even number of rows this exchanges shifted and unshifted rows, and the pattern is the
            # same; with an odd number it is not.
            index = np.arange(self.rows * self.columns)
            return index[None] if self.rows % 2 else np.stack([index, index[::-1]])
        return grid_symmetries(self.rows, self.columns)


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
        _require_markers(self.dictionary, self.ids[-1])

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
        _require_markers(self.dictionary, self.ids[-1])

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


def _require_markers(dictionary: str, last_id: int) -> None:
    """Raise a ValueError unless the dictionary exists and contains the marker with this number."""
    require_one_of("dictionary", dictionary, MARKER_COUNTS)
    count = MARKER_COUNTS[dictionary]
    if last_id >= count:
        raise ValueError(
            f"dictionary: {dictionary} has {count} markers, 0 to {count - 1}; "
            f"the target needs marker {last_id}"
        )
