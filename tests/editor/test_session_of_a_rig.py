"""The editor with pictures of two cameras, which differ in size, lens and place."""

import json

import numpy as np
import pytest
from rig_pair import BASE_FROM_WORLD, estimate, seen_by, stereo_pair

from smartview_jax.editor import ModelSession
from smartview_jax.editor.conversation import Conversation
from smartview_jax.geometry import host_matrices, look_at
from smartview_jax.modeling import RigViews

CAMERAS = ["left", "right", "left", "right"]
NAMES = ["left/a", "right/a", "left/b", "right/b"]
CORNER = np.array([[0.02, -0.01, 0.03]])
ROBOT_AS_REPORTED = np.zeros(6)


@pytest.fixture(scope="module")
def rig():
    return estimate(stereo_pair())


@pytest.fixture(scope="module")
def poses():
    """The hand in two states; both cameras take a picture in each."""
    looking = host_matrices(look_at(np.zeros(3), np.array([[0.3, 0.2, -1], [-0.3, 0.3, -1]]), 0.4))
    return (BASE_FROM_WORLD @ np.linalg.inv(looking))[[0, 0, 1, 1]]


@pytest.fixture
def session(rig, poses, tmp_path):
    sizes = {name: calibration.camera.image_size for name, calibration in rig.calibrations.items()}
    pictures = [np.full(sizes[name][::-1], 128, np.uint8) for name in CAMERAS]
    views, path = RigViews(rig, CAMERAS), tmp_path / "part.json"
    with ModelSession(views, poses, pictures, NAMES, path) as opened:
        yield opened


def clicks(rig, poses):
    exact = dict.fromkeys(rig.parameter_names, 0.0)
    return [
        seen_by(rig, name, exact, CORNER, pose, ROBOT_AS_REPORTED)[0]
        for name, pose in zip(CAMERAS, poses, strict=True)
    ]


def test_a_corner_that_both_cameras_see_is_placed_and_drawn_in_all_views(session, rig, poses):
    pixels = clicks(rig, poses)
    curves = session.curves("left/a", pixels[0])
    for name, pixel in zip(NAMES[1:], pixels[1:], strict=True):
        away = np.linalg.norm(curves[name].pixels - pixel, axis=1)
        assert away.min() < 5.0
    point = session.click("left/a", pixels[0])
    session.click("right/a", pixels[1], point)
    actual = session.estimates()[point]
    np.testing.assert_allclose(actual.position, CORNER[0], atol=1e-7)
    np.testing.assert_allclose(actual.predicted, pixels, atol=1e-3)
    assert actual.visible.all()


def test_each_view_has_the_size_of_its_picture(session, rig, poses):
    assert session.picture_sizes["left/b"] == (640, 480)
    # Within the right camera's picture, and outside the left one's.
    assert session.checked_pixel("right/b", [700.0, 500.0]) == (700.0, 500.0)
    with pytest.raises(ValueError, match=r"view left/b: .* outside the picture of 640 x 480 px"):
        session.checked_pixel("left/b", [700.0, 500.0])
    views = Conversation(session).greeting()["views"]
    assert [view["size"] for view in views] == [[640, 480], [800, 600]] * 2
    assert views[1]["focal_px"] == 950.0
    header = json.loads((session.path.parent / "part.json.journal").read_text().splitlines()[0])
    assert header["cameras"] == CAMERAS
    picture = np.zeros((480, 640), np.uint8)
    with pytest.raises(ValueError, match=r"^view right/a: .* 640 x 480 px, the camera 800 x 600"):
        ModelSession(RigViews(rig, CAMERAS[:2]), poses[:2], [picture] * 2, NAMES[:2])
