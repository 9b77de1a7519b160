"""What is sent arrives as it was, and does not stay in memory for ever."""

import gc
import weakref

import jax
import numpy as np
from fit_scenes import scene_of

from smartview_jax.fleet.transport import from_bytes, to_bytes


def test_a_data_set_arrives_and_leaves_again():
    data = scene_of(0).data
    received = from_bytes(to_bytes([data]))[0]
    assert jax.tree.structure(received) == jax.tree.structure(data)
    np.testing.assert_array_equal(received.observations.pixels, data.pixels)
    trace, arrays = weakref.ref(received), len(jax.live_arrays())
    del received
    gc.collect()
    # Equinox keeps each module that `pickle.loads` makes.
    assert trace() is None
    assert len(jax.live_arrays()) < arrays
