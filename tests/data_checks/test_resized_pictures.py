"""Of two equal parts of the views, the later one has the other camera."""

import numpy as np
from robot_motions import VIEWS, moving_alike, transform

from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.data_checks import TwoCameras


def test_of_two_halves_the_later_one_has_the_other_camera():
    robot, seen = moving_alike()
    wrong = seen @ transform([0.0, 5.0, 0.0], [0.05, 0.0, 0.0])
    is_early = np.arange(VIEWS) < VIEWS // 2
    by_first, by_second = (
        np.where(part[:, None, None], seen, wrong) for part in (~is_early, is_early)
    )
    cameras = tuple(Camera(f, f, 640.0, 480.0, Pinhole(), (1280, 960)) for f in (900.0, 800.0))
    parts = TwoCameras(cameras, np.stack([by_first, by_second]), is_early)
    divided = parts.divided_by_robot(robot)
    assert divided.is_later_part
    assert (divided.of_second == ~is_early).all()
    assert divided.cameras == cameras[::-1]
