"""Round parts: arcs of their rims, and outlines of their smooth sides."""

import jax.numpy as jnp
import numpy as np
import pytest
from drawn_edges import pinhole
from round_scene import POSES, SIZES, models, part, pictures
from scipy.spatial.transform import Rotation
from seen_scene import CALIBRATION, base_from_tool
from solids import box

from smartview_jax.localization import Wireframe, localize
from smartview_jax.localization.curves import Curves
from smartview_jax.localization.outlines import with_outline


def test_a_washer_and_a_pipe_are_found():
    """Rendered with four times as many sides as the models have."""
    found = localize(pictures(), base_from_tool(), CALIBRATION, models())
    assert [obj.model_index for obj in found.accepted] in ([0, 1], [1, 0])
    for obj in found.accepted:
        truth, middle = POSES[obj.model_index], obj.model.vertices.mean(axis=0)
        estimate = obj.world_from_object
        shift = (estimate - truth)[:3] @ np.append(middle, 1.0)
        axes = estimate[:3, 2] @ truth[:3, 2]
        assert np.linalg.norm(shift) < 5e-4
        assert np.degrees(np.arccos(min(abs(axes), 1.0))) < 0.5
        # No picture shows the turn about the axis.
        assert obj.covariance[5, 5] > np.deg2rad(1.0) ** 2


def test_zz_dump():
    import time
    import cProfile, pstats
    for k in range(2):
        t = time.process_time()
        pr = cProfile.Profile(); pr.enable()
        found = localize(pictures(), base_from_tool(), CALIBRATION, models())
        pr.disable()
        print("run", k, time.process_time() - t)
        pstats.Stats(pr).sort_stats("cumtime").print_stats(45)
    for o in found:
        T = POSES[o.model_index]
        print(o.model.name, o.verdict.decision, o.verdict.reasons, o.verdict.evidence, 1e3*(o.world_from_object-T)[:3,3], np.degrees(np.arccos(min(1,abs(o.world_from_object[:3,2]@T[:3,2])))))
        print(np.sqrt(np.diag(o.covariance)))
