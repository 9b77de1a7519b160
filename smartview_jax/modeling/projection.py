"""Project any number of points into all views, by one compiled program."""

import jax
import numpy as np
from jaxtyping import Array, Float

from ..cameras import Camera
from ..runtime.array_namespace import to_device
from ..runtime.compilation import compiled
from .view_poses import SeenViews

POINTS_PER_BATCH = 4096
"""Number of points that are projected at once."""


def project_points(
    views: SeenViews, points: Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, "views points 2"]:
    """Return the pixels of points (m, world) in all views; NaN outside picture or lens."""
    count = len(views.camera_from_world)
    pixels = np.empty((count, len(points), 2))
    for start in range(0, len(points), POINTS_PER_BATCH):
        part = points[start : start + POINTS_PER_BATCH]
        # Padded to one size, for which the program is compiled once.
        padded = np.zeros((POINTS_PER_BATCH, 3))
        padded[: len(part)] = part
        projected = _project(views.camera, to_device(views.padded), to_device(padded))
        pixels[:, start : start + len(part)] = np.asarray(projected)[:count, : len(part)]
    size = np.array(views.camera.image_size)
    # Comparisons with NaN are false, so that points without a pixel count as outside.
    with np.errstate(invalid="ignore"):
        within = (pixels > -0.5) & (pixels < size - 0.5)
    return np.where(within.all(axis=-1, keepdims=True), pixels, np.nan)


@compiled
def _project(
    camera: Camera,
    camera_from_world: Float[Array, "views 4 4"],
    points: Float[Array, "points 3"],
) -> Float[Array, "views points 2"]:
    """Return the pixels of points in all views."""

    def project_in_view(matrix: Float[Array, "4 4"]) -> Float[Array, "points 2"]:
        return camera.project(points @ matrix[:3, :3].T + matrix[:3, 3][None])[0]

    return jax.vmap(project_in_view)(camera_from_world)
