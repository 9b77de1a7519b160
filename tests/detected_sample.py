"""The package's sample, in whose pictures the circles are looked for once in a process."""

import functools
import shutil

from smartview_jax.io import load_dataset, sample_folder


@functools.cache
def detected_sample():
    """The sample's data set, which keeps no detections in the package's folder."""
    return load_dataset(sample_folder(), keep_detections=False)


def copied_views(folder, count=4):
    """A copy of the sample's first views, in which nothing was looked for yet."""
    # Without what somebody's run may have left there.
    shutil.copytree(sample_folder(), folder, ignore=shutil.ignore_patterns("detections.csv"))
    for view in range(count, 15):
        (folder / f"images/{view}.png").unlink()
    lines = (folder / "poses.csv").read_text().splitlines()
    (folder / "poses.csv").write_text("\n".join(lines[: 1 + count]) + "\n")
    return folder
