import cv2
import jax.numpy as jnp
import numpy as np
import pytest

import smartview_jax as sv
from smartview_jax import features
from smartview_jax.cameras import OpenCV4, Pinhole
from smartview_jax.features.appearance import PATCH_RADIUS

CAMERA = sv.Camera(600.0, 600.0, 319.5, 239.5, Pinhole(), (640, 480))
CENTRE = np.array([319.5, 239.5])


def picture(seed=0):
    noise = np.random.default_rng(seed).uniform(0.0, 255.0, (480, 640))
    smooth = cv2.GaussianBlur(noise, (0, 0), 4.0)
    return np.clip(128.0 + 8.0 * (smooth - smooth.mean()), 0, 255).astype(np.uint8)


def corners_at(pixels):
    count = len(pixels)
    return features.Features(
        np.asarray(pixels, dtype=float),
        np.tile(np.eye(2), (count, 1, 1)),
        np.full((count, 6), -1),
        np.zeros((0, 2, 2)),
        np.zeros((0, 2, 2, 2)),
        np.zeros((0, 3)),
        np.zeros((0, 3, 3)),
        (640, 480),
    )


def test_a_roll_of_the_camera_changes_nothing():
    angle = 0.7
    c, s = np.cos(angle), np.sin(angle)
    # The same scene by a camera that is rolled: x_rolled = R x.
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    offset = np.array([[50.0, 20.0], [-80.0, 60.0], [10.0, -90.0]])
    upright, rolled_pixels = CENTRE + offset, CENTRE + offset @ rotation[:2, :2].T
    matrix = np.column_stack([rotation[:2, :2], CENTRE - rotation[:2, :2] @ CENTRE])
    rolled = cv2.warpAffine(picture(), matrix, (640, 480), flags=cv2.INTER_CUBIC)
    x_axis = np.array([1.0, 0.0, 0.0])
    first = features.describe(picture(), CAMERA, corners_at(upright), x_axis)
    second = features.describe(rolled, CAMERA, corners_at(rolled_pixels), rotation @ x_axis)
    alike = first.patches @ second.patches.T
    assert np.diag(alike).min() > 0.98
    unlike = alike[~np.eye(3, dtype=bool)]
    assert unlike.max() < 0.8
    unturned = features.describe(rolled, CAMERA, corners_at(rolled_pixels), x_axis)
    assert (first.patches * unturned.patches).sum(axis=1).max() < 0.9


def test_the_lens_is_taken_out():
    lens = OpenCV4(jnp.asarray(-0.5), jnp.asarray(0.1), jnp.asarray(0.0), jnp.asarray(0.0))
    bent = sv.Camera(600.0, 600.0, 319.5, 239.5, lens, (640, 480))
    K = np.array([[600.0, 0.0, 319.5], [0.0, 600.0, 239.5], [0.0, 0.0, 1.0]])
    coefficients = np.array([-0.5, 0.1, 0.0, 0.0])
    # What the bent camera sees, by OpenCV: the level of the straight picture where each ray goes.
    v, u = np.mgrid[:480, :640].astype(float)
    grid = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    straight = cv2.undistortPoints(grid, K, coefficients, P=K).reshape(480, 640, 2)
    seen = cv2.remap(
        picture(), *(straight[..., k].astype(np.float32) for k in (0, 1)), cv2.INTER_CUBIC
    )
    ideal = CENTRE + np.array([[190.0, 130.0], [-200.0, 120.0], [180.0, -140.0]])
    rays = np.column_stack([(ideal - CENTRE) / 600.0, np.ones(3)])
    pixels = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, coefficients)[0][:, 0]
    x_axis = np.array([1.0, 0.0, 0.0])
    first = features.describe(picture(), CAMERA, corners_at(ideal), x_axis)
    second = features.describe(seen, bent, corners_at(pixels), x_axis)
    # Without the lens's stretching of the patches it would be 0.965.
    assert (first.patches * second.patches).sum(axis=1).min() > 0.99


def test_patches_are_normalised_and_zero_without_contrast():
    level = picture()
    level[:100, :100] = 90
    look = features.describe(
        level, CAMERA, corners_at([[50.0, 50.0], [300.0, 200.0]]), np.array([1.0, 0.0, 0.0])
    )
    assert look.patches.shape == (2, (2 * PATCH_RADIUS + 1) ** 2)
    assert np.linalg.norm(look.patches[0]) == 0.0
    assert np.linalg.norm(look.patches[1]) == pytest.approx(1.0)


def test_directions_are_those_of_the_segments_from_the_corner():
    level = np.full((480, 640), 60, np.uint8)
    cv2.rectangle(level, (200, 150), (400, 300), 180, -1)
    in_picture = features.find(level, CAMERA)
    look = features.describe(level, CAMERA, in_picture, np.array([1.0, 0.0, 0.0]))
    corner = int(np.argmin(np.linalg.norm(in_picture.corners - [199.5, 149.5], axis=1)))
    angles = np.sort(look.directions[corner][np.isfinite(look.directions[corner])])
    # Away from the optical axis the patch's plane is tilted, and a right angle nearly one.
    np.testing.assert_allclose(angles, [0.0, 0.5 * np.pi], atol=0.03)
