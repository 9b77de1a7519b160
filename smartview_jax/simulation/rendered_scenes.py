"""Simulate scenes from rendered pictures, in which a detector finds the target points."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..calibration import Calibration
from ..dataset import Dataset
from ..detection import detect
from ..geometry import PoseLike, as_se3
from ..targets import AbstractTarget
from .render import render
from .scenes import Scene

MAX_DETECTION_ERROR = 5.0
"""Largest distance, px, of a detected point from its true projection.

A detection farther away belongs to another point.
"""


def rendered_scene(
    calibration: Calibration,
    base_from_tool: PoseLike,
    target: AbstractTarget,
    reported_poses: PoseLike | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
    **options: Any,
) -> Scene:
    """Render a picture of a target from every robot pose, at every height, and detect the target.

    If a target looks the same in several orders of its points, the order closest to the truth is
    used, so that the fitted world frame is the true one. A picture in which the target is not found
    has no visible points.

    Args:
        base_from_tool: `(views)` true robot poses.
        reported_poses: `(views)` poses that the robot reports; the true ones by default.
        seed: seed of the sensor's noise.
        progress: called with a text for each view.
        options: passed on to `render`, other than its height and seed.
    """
    poses = as_se3(base_from_tool)
    board, height_count = target.flat_board, target.height_count
    views = len(poses.wxyz_xyz)
    true_pixels = np.asarray(calibration.project(poses, target.points)[0])
    pixels = np.empty_like(true_pixels).reshape(views, height_count, -1, 2)
    for view in range(views):
        if progress is not None:
            progress(f"view {view + 1} of {views}")
        pose = SE3(poses.wxyz_xyz[view])
        for height_index in range(height_count):
            # Independent noise for each picture, whatever the number of views or heights.
            seed_sequence = np.random.SeedSequence((seed, view, height_index))
            picture_seed = int(seed_sequence.generate_state(1)[0])
            picture = render(
                calibration, pose, target, height_index=height_index, seed=picture_seed, **options
            )
            picture_pixels = true_pixels[view].reshape(height_count, -1, 2)[height_index]
            pixels[view, height_index] = _order_nearest_truth(
                detect(picture, board).pixels, picture_pixels, board
            )
    data = Dataset.from_arrays(
        target.points,
        pixels.reshape(true_pixels.shape),
        poses if reported_poses is None else as_se3(reported_poses),
        image_size=calibration.camera.image_size,
        mount=calibration.mount,
        target=target,
    )
    return Scene(data, calibration, poses, jnp.zeros(data.visible.shape, dtype=bool))


def _order_nearest_truth(
    detected: Float[np.ndarray, "points 2"],
    true_pixels: Float[np.ndarray, "points 2"],
    board: AbstractTarget,
) -> Float[np.ndarray, "points 2"]:
    """Return the detected points in the order closest to the truth; NaN if no order is close."""
    # The distance of an order is the largest of its points' distances, since one swapped pair
    # disqualifies it. Missing points are ignored.
    errors = [np.abs(detected[order] - true_pixels) for order in board.symmetries]
    max_errors = [np.nanmax(error, initial=0.0) for error in errors]
    best = int(np.argmin(max_errors))
    return (
        detected[board.symmetries[best]]
        if max_errors[best] < MAX_DETECTION_ERROR
        else np.full_like(detected, np.nan)
    )
