"""Limit the search for points to a part of space: a box, and rectangles in pictures."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclasses.dataclass(frozen=True, eq=False)
class Region:
    """The part of space in which an object's points are searched.

    A rectangle selects everything in space that is seen in it. So a rectangle around the object in
    one picture leaves out whatever is next to it, in all views; a second one, in a view from
    another direction, leaves out whatever is in front of it or behind.

    Attributes:
        box: smallest and largest x, y and z in the world, m; infinite where a side is open. None
            for no limit.
        rectangles: around the object in pictures, by the view's index: smallest u and v, then
            largest u and v, px. `check` rejects invalid ones.
    """

    box: Float[np.ndarray, "2 3"] | Sequence[Sequence[float | int]] | None = None
    rectangles: Mapping[int, Any] = dataclasses.field(default_factory=dict)

    def check(self, names: Sequence[str], image_sizes: Int[np.ndarray, "views 2"]) -> None:
        """Raise an error for a box or a rectangle that has nothing inside.

        Args:
            names: of the views, for the message.
            image_sizes: width and height of each picture, px.

        Raises:
            ValueError: the message names the view and what was found.
        """
        if self.box is not None:
            box = np.asarray(self.box, dtype=float)
            # NaN fails the comparison, too.
            if box.shape != (2, 3) or not (box[0] < box[1]).all():
                raise ValueError(
                    "region: a box has smallest x, y and z (m) below its largest ones; "
                    f"found {box.tolist()}"
                )
        for view, rectangle in self.rectangles.items():
            # A negative index would silently select another view, counted from the end.
            if view not in range(len(names)):
                raise ValueError(
                    f"region: there is no view number {view}, only 0 to {len(names) - 1}"
                )
            _check_rectangle(rectangle, names[view], image_sizes[view])

    def contains(
        self,
        points: Float[np.ndarray, "points 3"],
        projected: Float[np.ndarray, "views points 2"],
    ) -> Bool[np.ndarray, "points"]:
        """Return which points are in the box and are seen within all rectangles.

        Args:
            points: in the world, m.
            projected: their pixels in all views; NaN outside a picture, and so in none of its
                rectangles.
        """
        inside = np.ones(len(points), dtype=bool)
        if self.box is not None:
            low, high = np.asarray(self.box, dtype=float)
            inside &= ((points >= low) & (points <= high)).all(axis=1)
        with np.errstate(invalid="ignore"):
            for view, rectangle in self.rectangles.items():
                low, high = np.reshape(np.asarray(rectangle, dtype=float), (2, 2))
                pixels = projected[view]
                inside &= ((pixels >= low) & (pixels <= high)).all(axis=1)
        return inside


def _check_rectangle(rectangle: Any, view: str, image_size: Int[np.ndarray, "2"]) -> None:
    """Raise an error for a rectangle without a pixel of its picture."""
    try:
        left, top, right, bottom = (float(number) for number in rectangle)
    except (TypeError, ValueError):
        raise ValueError(
            f"region: view {view}: a rectangle is four numbers, smallest u and v and largest u "
            f"and v (px); found {rectangle!r}"
        ) from None
    if not (left < right and top < bottom):
        raise ValueError(
            f"region: view {view}: expected u {left:g} below {right:g} and v {top:g} below "
            f"{bottom:g} px"
        )
    # It may extend beyond the border: people draw rectangles generously.
    width, height = image_size
    if right < 0 or bottom < 0 or left > width - 1 or top > height - 1:
        raise ValueError(
            f"region: view {view}: the rectangle ({left:g}, {top:g}) to ({right:g}, {bottom:g}) "
            f"is outside of the picture of {width} x {height} px"
        )
