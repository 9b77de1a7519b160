import numpy as np
from solids import box

from smartview_jax.features import picture_evidence
from smartview_jax.plots import cropped, edge_map, with_wireframes
from smartview_jax.plots.object_pictures import CORNER_COLOUR
from smartview_jax.simulation import drawn_calibration

CAMERA = drawn_calibration().camera


def test_wireframes_are_drawn_where_the_camera_sees_their_edges():
    pose = np.eye(4)
    pose[:3, 3] = [-0.03, -0.02, 0.4]
    drawn = with_wireframes(None, CAMERA, np.eye(4), [(box(), pose)])
    ground = drawn[0, 0]
    # The near face, at z = 0.4 m, from (-30, -20) to (30, 20) mm.
    corners = np.array([[-0.03, -0.02], [0.03, 0.02]]) / 0.4 * 1400.0 + [640.0, 400.0]
    (left, top), (right, bottom) = np.rint(corners).astype(int)
    middle = (top + bottom) // 2
    for u in (left, right):
        assert (drawn[middle, u - 1 : u + 2] != ground).any()
    # Between the contours there is nothing: the far face is hidden.
    assert (drawn[middle, left + 4 : right - 3] == ground).all()


def test_edge_maps_show_points_and_corners_of_the_picture():
    picture = np.full((800, 1280), 60, np.uint8)
    picture[300:500, 400:700] = 200
    shown = edge_map(picture_evidence(picture, CAMERA))
    assert shown.shape == (800, 1280, 3)
    # Along the left side of the square there is an edge, and at its corner a circle.
    assert (shown[400, 396:404] > 60).any()
    near = shown[290:312, 390:412].reshape(-1, 3).astype(int)
    assert (np.abs(near - CORNER_COLOUR).sum(axis=1) < 60).any()
    assert (shown[100:200, 100:200] == shown[0, 0]).all()


def test_the_part_about_some_pixels_is_cut_out():
    picture = np.arange(100 * 200).reshape(100, 200)
    part = cropped(picture, np.array([[50.0, 40.0], [60.0, 45.0], [np.nan, 0.0]]), margin=5.0)
    assert part[0, 0] == picture[35, 45]
    assert part.shape == (15, 20)
