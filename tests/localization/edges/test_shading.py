"""Edges next to a round surface: how far its shading moves the peak of a blurred picture."""

import jax.numpy as jnp
import numpy as np
from drawn_edges import pinhole
from round_scene import SIZES, models
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from smartview_jax.localization import Wireframe, pose_jacobians, predict_view
from smartview_jax.localization.edges.edge_line_fit import EDGE_BLUR
from smartview_jax.localization.edges.outlines import with_outline
from smartview_jax.localization.edges.prediction import centre_in_object
from smartview_jax.localization.edges.shading import shading_shifts
from smartview_jax.runtime.compilation import compiled

RADIUS = SIZES["pipe"][0]
FOCAL = 1500.0
STEP = 0.01


@compiled
def _shifts(wireframe, camera, pose):
    view, centre = predict_view(wireframe, camera, pose), centre_in_object(pose)
    seen = with_outline(wireframe, centre)
    J = pose_jacobians(seen.samples, camera, pose)[1][..., :3]
    d = view.directions
    n = jnp.stack([-d[:, 1], d[:, 0]], axis=1)
    across, along = (jnp.einsum("si,sij->sj", axis, J) for axis in (n, d))
    return seen, view, n, shading_shifts(seen, centre, across, along)


def angles_on_pipe(pixels, pose):
    """Where the rays of pixels meet the pipe first: the angle about its axis; NaN where not."""
    R, t = pose[:3, :3], pose[:3, 3]
    origin = (-R.T @ t)[:2]
    rays = np.column_stack([(pixels - [325.0, 236.0]) / FOCAL, np.ones(len(pixels))]) @ R
    a, b = (rays[:, :2] ** 2).sum(axis=1), rays[:, :2] @ origin
    squared = b**2 - a * (origin @ origin - RADIUS**2)
    distance = (-b - np.sqrt(np.where(squared > 0.0, squared, np.nan))) / a
    return np.arctan2(*(origin + distance[:, None] * rays[:, :2]).T[::-1])


def peak_of(brightness, places):
    """Where the blurred brightness changes fastest, and its slope there."""
    slope = gaussian_filter1d(brightness, EDGE_BLUR / STEP, order=1) / STEP
    first = len(places) // 2 - 300
    k = first + int(np.argmax(np.abs(slope)[first : first + 600]))
    low, middle, high = slope[k - 1 : k + 2]
    return places[k] + STEP * 0.5 * (low - high) / (low - 2.0 * middle + high), middle


def brightness_along(line, side, pose, shade):
    """Of a wall on one side of the middle of a line of pixels, on a black ground."""
    angles = angles_on_pipe(line, pose)
    return np.where(side & np.isfinite(angles), shade(np.nan_to_num(angles)), 0.0)


def test_shading_moves_rims_and_outlines_as_far_as_a_blurred_picture_shows():
    """Light from the camera changes an outline's brightness most, light from one side a rim's.

    The displacement is of first order in the brightness, and the wall turns within the blur.
    """
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("zx", [0.3, 2.3]).as_matrix()
    pose[:3, 3] = [0.004, -0.003, 0.35]
    wireframe = Wireframe.of(models()[1], 512)
    seen, view, normals, shifts = _shifts(wireframe, pinhole(FOCAL, FOCAL), jnp.asarray(pose))
    points, pixels, normals = (np.asarray(x) for x in (seen.samples, view.samples, normals))
    visible, is_outline = np.asarray(view.sample_visible), np.asarray(seen.sample_radii) > 0.0
    here, height = np.arctan2(points[:, 1], points[:, 0]), points[:, 2]
    centre = -pose[:3, :3].T @ pose[:3, 3]
    towards = np.arctan2(centre[1], centre[0])
    # The far end of the pipe, whose wall is seen, away from the outline; and the outline away from
    # both ends.
    is_rim = ~is_outline & (height < height[~is_outline].min() + 1e-6)
    is_rim &= np.hypot(*points[:, :2].T) > 0.9 * RADIUS
    is_rim &= np.cos(here - towards) > 0.5
    is_middle = is_outline & (np.abs(height) < 0.5 * RADIUS)
    middle = pixels[is_outline & visible].mean(axis=0)
    step, b = 100.0, 5.0
    places = np.arange(-3000, 3001) * STEP
    for chosen, atol in ((is_rim & visible, 0.12), (is_middle & visible, 0.05)):
        for k in np.flatnonzero(chosen)[:: max(1, chosen.sum() // 5)]:
            line = pixels[k] + places[:, None] * normals[k]
            side = places * float(np.sign(normals[k] @ (middle - pixels[k]))) > 0.0
            lights = (
                (lambda angles: step + b * np.cos(angles - towards))
                if is_outline[k]
                else (lambda angles, k=k: step + b * np.sin(angles - here[k]))
            )
            moved, slope = peak_of(brightness_along(line, side, pose, lights), places)
            still, _ = peak_of(brightness_along(line, side, pose, np.ones_like), places)
            # The change over a quarter turn as the usual edge of a picture.
            usual = b / (np.sqrt(2.0 * np.pi) * EDGE_BLUR)
            expected = float(shifts[k]) * usual / abs(slope)
            np.testing.assert_allclose(abs(moved - still) / expected, 1.0, atol=atol)
