import numpy as np
import pytest

from smartview_jax.geometry import ViewedRegion, region_from_dict, region_to_dict

POINTS = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.0, 0.2, 0.02], [0.2, 0.2, 0.02]])
CAMERAS = np.array([[0.0, 0.1, 0.5], [0.2, 0.1, 0.7], [0.1, 0.4, 0.6]])


@pytest.mark.parametrize(("sign", "above", "plane"), [(1.0, True, 0.0), (-1.0, False, 0.02)])
def test_the_side_is_that_of_all_cameras(sign, above, plane):
    cameras = CAMERAS * [1.0, 1.0, sign]
    region = ViewedRegion.from_positions(cameras, POINTS, cameras - [0.0, 0.0, 0.1])
    assert region.above is above
    assert float(region.plane_z) == plane
    heights = np.asarray(region.height(cameras))
    np.testing.assert_allclose(heights, CAMERAS[:, 2] + (0.0 if above else 0.02))
    lowest = 0.4 if above else 0.62
    assert float(region.min_tool_height) == pytest.approx(lowest)
    # The unit is the farthest distance from the target, where that is larger than the radius.
    unit = max(float(region.radius), float(region.distance_range[1]))
    np.testing.assert_allclose(
        np.asarray(region.normalised_distance(cameras)).max(), float(region.radius) / unit
    )
    middle = POINTS.mean(axis=0)
    away = np.linalg.norm(cameras - middle, axis=1)
    np.testing.assert_allclose(region.distance_range, [away.min(), away.max()])


def test_cameras_on_both_sides_have_no_side():
    cameras = CAMERAS * [[1.0, 1.0, 1.0], [1.0, 1.0, -1.0], [1.0, 1.0, 1.0]]
    region = ViewedRegion.from_positions(cameras, POINTS, cameras)
    assert region.above is None
    assert np.isinf(region.min_tool_height)


def test_cameras_in_one_place_know_a_tenth_of_the_distance():
    region = ViewedRegion.from_positions(np.tile(CAMERAS[:1], (3, 1)), np.zeros((1, 3)))
    assert float(region.radius) == pytest.approx(0.1 * np.linalg.norm(CAMERAS[0]))


@pytest.mark.parametrize("tools", [None, CAMERAS])
def test_a_region_is_written_and_read_back(tools):
    region = ViewedRegion.from_positions(CAMERAS, POINTS, tools)
    again = region_from_dict(region_to_dict(region))
    for name in ("side", "plane_z", "centroid", "radius", "distance_range", "min_tool_height"):
        np.testing.assert_array_equal(getattr(again, name), getattr(region, name))
