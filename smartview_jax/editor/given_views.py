"""Check the views given to a session: names and pictures."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..argument_checks import require_distinct, require_readable
from ..detection import read_picture

MIN_VIEWS = 2
"""Smallest number of views of a session, for triangulation."""


def checked_names(names: Sequence[str] | None, count: int) -> list[str]:
    """Return the views' names, or raise an error for too few or repeated names."""
    if count < MIN_VIEWS:
        raise ValueError(f"a session needs at least {MIN_VIEWS} views; found {count}")
    given = [f"v{1 + k}" for k in range(count)] if names is None else [str(name) for name in names]
    if len(given) != count:
        raise ValueError(f"expected a name for each of {count} pictures, found {len(given)}")
    require_distinct("names", given)
    require_readable("names", given)
    return given


def checked_picture(
    picture: np.ndarray | str | os.PathLike[str], name: str, size: tuple[int, int]
) -> np.ndarray:
    """Return a grey picture of the camera's size, or raise an error that names the view."""
    try:
        if not isinstance(picture, np.ndarray):
            return read_picture(Path(picture), size)
        grey = picture.mean(axis=2).astype(np.uint8) if picture.ndim == 3 else picture
        if grey.dtype != np.uint8 or grey.ndim != 2:
            raise ValueError(f"expected uint8, grey or BGR; found {picture.dtype} {picture.shape}")
        if grey.shape[::-1] != size:
            width, height = grey.shape[::-1]
            raise ValueError(
                f"the picture has {width} x {height} px, the camera {size[0]} x {size[1]} px"
            )
        return grey
    except ValueError as error:
        raise ValueError(f"view {name}: {error}") from None
