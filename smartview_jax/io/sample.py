"""The real data set that ships in the package."""

from importlib.resources import files
from pathlib import Path

SAMPLE = "rct_circle10x10"


def sample_folder() -> Path:
    """The folder of the sample: 15 pictures of a 10 x 10 circle grid, taken by a robot's camera."""
    return Path(str(files("smartview_jax") / "samples" / SAMPLE))
