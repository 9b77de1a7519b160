"""Against the simulated truth: where the cameras stood, for both mounts."""

import dataclasses

import numpy as np
import pytest
from jaxlie import SE3

from smartview_jax import Calibration, Dataset
from smartview_jax.simulation import paper_calibration
from smartview_jax.staged import with_region


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
def test_the_region_is_that_of_the_cameras(scene, mount):
    truth, data = paper_calibration(), scene.data
    cameras = truth.camera_from_world(scene.base_from_tool).inverse().translation()
    if mount == "eye_to_hand":
        data = dataclasses.replace(data, mount=mount, base_from_tool=data.base_from_tool.inverse())
        truth = Calibration.eye_to_hand(
            truth.camera, truth.camera_from_mount, truth.holder_from_world
        )
    region = with_region(truth, data).region
    assert region is not None
    assert region.above is True
    np.testing.assert_allclose(region.centroid, np.asarray(cameras).mean(axis=0), atol=1e-9)
    # Distances that views are drawn from.
    assert 0.16 < float(region.distance_range[0]) < float(region.distance_range[1]) < 0.26
    assert np.isinf(region.min_tool_height) == (mount == "eye_to_hand")
    some = with_region(truth, data, np.array([1, 2])).region
    assert some is not None
    assert float(some.radius) < float(region.radius)


def test_a_calibration_that_is_not_finite_stays_as_it_is(scene):
    lost = dataclasses.replace(
        paper_calibration(), camera_from_mount=SE3(np.nan * SE3.identity().wxyz_xyz)
    )
    assert with_region(lost, scene.data).region is None
    assert (
        with_region(
            lost,
            Dataset.from_arrays(
                scene.data.points,
                np.full(scene.data.pixels.shape, np.nan),
                scene.data.base_from_tool,
                scene.data.image_size,
            ),
        ).region
        is None
    )


def test_the_region_is_saved_with_the_calibration(scene, tmp_path):
    known = with_region(paper_calibration(), scene.data)
    known.save(tmp_path / "calibration.yaml")
    again = Calibration.load(tmp_path / "calibration.yaml").region
    assert again is not None
    assert known.region is not None
    np.testing.assert_array_equal(again.centroid, known.region.centroid)
    assert again.above is True
    text = (tmp_path / "calibration.yaml").read_text().replace("side: +z", "side: up")
    (tmp_path / "calibration.yaml").write_text(text)
    with pytest.raises(ValueError, match=r"calibration\.yaml: region\.side is one of"):
        Calibration.load(tmp_path / "calibration.yaml")
