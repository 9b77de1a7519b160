"""Locate the data sets that are part of the package."""

from importlib.resources import files
from pathlib import Path

SAMPLE_NAME = "rct_circle10x10"
"""The name of the folder of the sample data set."""

OBJECT_SAMPLE_NAME = "stepped_block"
"""The name of the folder of the object sample."""


def sample_folder() -> Path:
    """Return the sample's folder: 15 pictures of a 10 x 10 circle grid by a camera on a robot."""
    return Path(str(files("smartview_jax") / "samples" / SAMPLE_NAME))


def object_sample_folder() -> Path:
    """Return the folder of the object sample: pictures of a board, and of a block with a step.

    The pictures are rendered (`simulation.write_object_example`). The folder itself is the data set
    that calibrates the rig (`load_dataset`), its folder `object` has the pictures of the object
    from five viewpoints (`load_object_views`), and `truth.json` the object's vertices and faces.
    """
    return Path(str(files("smartview_jax") / "samples" / OBJECT_SAMPLE_NAME))
