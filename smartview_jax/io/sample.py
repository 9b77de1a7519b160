"""Locate the real data set that is part of the package."""

from importlib.resources import files
from pathlib import Path

SAMPLE_NAME = "rct_circle10x10"
"""The name of the folder of the sample data set."""


def sample_folder() -> Path:
    """Return the sample's folder: 15 pictures of a 10 x 10 circle grid, by a camera on a robot."""
    return Path(str(files("smartview_jax") / "samples" / SAMPLE_NAME))
