"""Pictures as a calibrated camera would take them: every pixel looks where its ray meets the board.

Nothing is approximated but the pixel's area, which is sampled: the lens bends rays as the
calibration says, so a detector's answer can be held against `Calibration.project`.
"""

from pathlib import Path
from typing import Any

import cv2
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float, UInt8

from ..calibration import Calibration
from ..cameras import Camera
from ..compilation import optimised
from ..files import write_atomically
from ..geometry import PoseLike, as_se3
from ..io import write_folder
from ..targets import AbstractTarget, StackedTarget
from .patterns import dark_places

DARK, LIGHT, SURROUNDINGS = 40.0, 215.0, 120.0
"""Grey levels of print, of paper, and of whatever is not the board's front."""

ROWS = 64
"""Rows of a picture that are sampled at once."""


def render(
    calibration: Calibration,
    base_from_tool: PoseLike,
    target: AbstractTarget,
    *,
    height: int = 0,
    blur: float = 0.7,
    noise: float = 1.0,
    seed: int = 0,
    samples: int = 4,
) -> UInt8[np.ndarray, "rows columns"]:
    """The picture of a target from one robot pose.

    Args:
        calibration: camera, mount and where the target stands.
        base_from_tool: the true robot pose, one.
        target: its front is drawn; from behind there is nothing to see.
        height: which of a `StackedTarget`'s heights the board is placed at.
        blur: standard deviation of the lens's blur, px.
        noise: standard deviation of the sensor's, grey levels.
        seed: of the noise.
        samples: rays a pixel in each direction.
    """
    board, z = target, 0.0
    if isinstance(target, StackedTarget):
        board, z = target.board, target.heights[height] * float(calibration.target_scale)
    camera_from_world = calibration.camera_from_world(base_from_tool)
    place, ahead = _looked_at(calibration.camera, camera_from_world, z, target.y_up, samples)
    place = place / float(calibration.target_scale)
    down = 1.0 if board.y_up == target.y_up else -1.0
    dark = dark_places(board)(place[..., 0].ravel(), down * place[..., 1].ravel())
    shade = np.where(dark.reshape(ahead.shape), DARK, LIGHT)
    picture = np.where(ahead, shade, SURROUNDINGS)
    width, rows = calibration.camera.image_size
    picture = picture.reshape(rows, samples, width, samples).mean(axis=(1, 3))
    if blur > 0.0:
        picture = cv2.GaussianBlur(picture, (0, 0), blur)
    picture = picture + noise * np.random.default_rng(seed).standard_normal(picture.shape)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def _looked_at(
    camera: Camera, camera_from_world: SE3, z: float, front_is_up: bool, samples: int
) -> tuple[np.ndarray, np.ndarray]:
    """Where every sample's ray meets the plane at height z (x, y, m), and whether in front."""
    width, rows = camera.image_size
    u = (np.arange(width * samples) + 0.5) / samples - 0.5
    v = (np.arange(rows * samples) + 0.5) / samples - 0.5
    plane = jnp.asarray(z)
    parts = [
        _meet_plane(camera, camera_from_world, jnp.asarray(u), jnp.asarray(some), plane)
        for some in np.split(v, range(ROWS * samples, len(v), ROWS * samples))
    ]
    place = np.concatenate([np.asarray(part[0]) for part in parts])
    ahead = np.concatenate([np.asarray(part[1]) for part in parts])
    centre = float(camera_from_world.inverse().translation()[2])
    return place, ahead & ((centre > z) == front_is_up)


@optimised
def _meet_plane(
    camera: Camera,
    camera_from_world: SE3,
    u: Float[Array, "columns"],
    v: Float[Array, "rows"],
    z: Float[Array, ""],
) -> tuple[Float[Array, "rows columns 2"], Array]:
    pixels = jnp.stack(jnp.meshgrid(u, v), axis=-1)
    rays, valid = camera.unproject(pixels)
    world_from_camera = camera_from_world.inverse()
    direction = rays @ world_from_camera.rotation().as_matrix().T
    centre = world_from_camera.translation()
    away = (z - centre[2]) / jnp.where(direction[..., 2] == 0.0, jnp.inf, direction[..., 2])
    place = centre[:2][None, None] + away[..., None] * direction[..., :2]
    ahead = valid & (away > 0.0)
    return jnp.where(ahead[..., None], place, 0.0), ahead


def write_pictures(
    folder: str | Path,
    calibration: Calibration,
    base_from_tool: PoseLike,
    target: AbstractTarget,
    reported: PoseLike | None = None,
    **options: Any,
) -> Path:
    """A data-set folder with a rendered picture for every robot pose, and for every height.

    Args:
        folder: to be made; `load_dataset` reads it.
        calibration: the truth.
        base_from_tool: `(views)` true robot poses.
        target: what the pictures show.
        reported: `(views)` what the robot says; the truth by default.
        options: passed on to `render`, other than its height and seed.
    """
    folder, poses = Path(folder), as_se3(base_from_tool)
    heights = len(target.heights) if isinstance(target, StackedTarget) else 1
    views = [str(k) for k in range(len(poses.wxyz_xyz))]
    pattern = "images/{view}_{height}.png" if heights > 1 else "images/{view}.png"
    for k, view in enumerate(views):
        pose = SE3(poses.wxyz_xyz[k])
        for height in range(heights):
            seen = render(
                calibration, pose, target, height=height, seed=k * heights + height, **options
            )
            path = folder / pattern.format(view=view, height=height)
            write_atomically(path, cv2.imencode(".png", seen)[1].tobytes())
    write_folder(
        folder,
        views,
        poses if reported is None else as_se3(reported),
        calibration.camera.image_size,
        target,
        calibration.mount,
        {"pictures": {"pattern": pattern}},
    )
    return folder
