"""The package's sample, in whose pictures the circles are looked for once in a process."""

import functools

from smartview_jax.io import load_dataset, sample_folder


@functools.cache
def detected_sample():
    """The sample's data set, which keeps no detections in the package's folder."""
    return load_dataset(sample_folder(), keep_detections=False)
