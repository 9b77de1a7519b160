"""Check clicks before they are kept: a view that exists, and a pixel within its picture."""

from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

PictureSizes: TypeAlias = Mapping[str, tuple[int, int]]
"""The width and height of each view's picture, px, by the view's name."""


def check_clicks(change: Mapping[str, Any], sizes: PictureSizes) -> None:
    """Raise an error for a change with a click in an unknown view or outside its picture.

    Args:
        change: as `document.apply_change` describes it.
        sizes: width and height of each view's picture, px, by the view's name.
    """
    # All parts of a change are checked before any of them is made.
    clicks = dict(change.get("clicks") or {})
    if change.get("do") == "click":
        clicks[change.get("view")] = change.get("pixel")
    for view, pixel in clicks.items():
        checked_pixel(view, pixel, sizes)
    for part in change.get("changes") or ():
        check_clicks(part, sizes)


def check_view(view: Any, names: Iterable[str]) -> None:
    """Raise an error for a view that does not exist."""
    # A page's message may hold anything, also what no mapping can look up.
    if view not in list(names):
        raise ValueError(f"no view {view!r}; the views are {', '.join(names)}")


def checked_pixel(view: Any, pixel: Any, sizes: PictureSizes) -> tuple[float, float]:
    """Return a pixel of a view, or raise an error that names both."""
    check_view(view, sizes)
    # The page's messages are not validated: text, null and three numbers are possible.
    try:
        # Texts of digits and true would pass as numbers.
        if any(isinstance(number, str | bool) for number in pixel):
            raise TypeError
        u, v = (float(number) for number in pixel)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"view {view}: a pixel is two numbers; found {pixel!r}") from None
    width, height = sizes[view]
    # NaN fails this comparison too.
    if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
        raise ValueError(
            f"view {view}: the click ({u:g}, {v:g}) is outside the picture of {width} x {height} px"
        )
    return u, v
