"""Load the data set that a subcommand works on."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..dataset import Dataset


def load_named(
    dataset: Path | None,
    bad_views: str,
    progress: Callable[[str], None],
    base_from_world: str | None = None,
) -> "tuple[Dataset, str]":
    """Load a data set (the sample if none is named), and return it with its name."""
    from ..io import load_dataset, parse_rough_pose, sample_folder

    rough_pose = None
    if base_from_world is not None:
        rough_pose = parse_rough_pose("--base-from-world", base_from_world)

    if dataset is None:
        # The sample belongs to the installed package, and nothing is written to its folder.
        progress("no data set given: the sample of the package")
        return load_dataset(sample_folder(), progress=progress, keep_detections=False), "the sample"
    data = load_dataset(dataset, bad_views, progress=progress, holder_from_world=rough_pose)
    return data, dataset.resolve().name
