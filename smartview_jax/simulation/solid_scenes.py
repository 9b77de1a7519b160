"""Render solid objects as a calibrated camera sees them, by casting rays through its lens.

Rays start at pixels and follow `Camera.unproject`, so that straight edges are bent exactly as the
lens bends them, and a vertex appears where `Calibration.project` puts it. Every pixel is sampled
once; pixels at edges (of surfaces, shadows or textures) are sampled many times.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Unpack

import cv2
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from ..calibration import Calibration
from ..cameras import Camera
from ..geometry import PoseLike, as_se3, host_matrices
from ..runtime.compilation import compiled_optimised
from ..runtime.padding import in_batches
from .polyhedra import Polyhedron
from .ray_casting import MISSED, Hits, RayCaster
from .render import SensorOptions, sensor_picture
from .textures import Texture, matt

RAYS_PER_BATCH = 65_536
"""Number of rays cast at once: one compiled program, and bounded memory."""

MAX_SMOOTH_STEP = 4.0
"""Difference between neighbouring pixels, grey levels, above which both are sampled many times."""

WHITE_LEVEL = 230.0
"""Grey level of a white surface in full light, at an exposure of one."""


class Surface(NamedTuple):
    """A triangle mesh in the world's frame and its texture.

    Attributes:
        vertices: m.
        triangles: indices of the vertices.
        texture: albedo by the points of the mesh.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    triangles: Int[np.ndarray, "triangles 3"]
    texture: Texture = matt(0.6)

    @classmethod
    def of_polyhedron(cls, solid: Polyhedron, texture: Texture) -> "Surface":
        """Return the surface of a polyhedron."""
        return cls(solid.vertices, solid.triangles, texture)

    @classmethod
    def of_plane(cls, half_width: float, texture: Texture) -> "Surface":
        """Return a square of the plane z = 0 about the z axis, such as a table, m."""
        x, y = half_width * np.array([[-1.0, 1.0, 1.0, -1.0], [-1.0, -1.0, 1.0, 1.0]])
        vertices = np.column_stack([x, y, np.zeros(4)])
        return cls(vertices, np.array([[0, 1, 2], [0, 2, 3]]), texture)


class Light(NamedTuple):
    """A distant light, whose shadows are sharp.

    Attributes:
        direction: from the scene to the light, in the world's frame, of any length but zero.
        strength: fraction of full light on a surface perpendicular to it.
    """

    direction: tuple[float, float, float]
    strength: float


class SolidScene(NamedTuple):
    """Surfaces and their illumination.

    Attributes:
        surfaces: all visible surfaces.
        lights: distant lights, which add up.
        ambient: light from all directions, as a fraction of full light, without shadows.
        background: grey level where there is no surface.
    """

    surfaces: Sequence[Surface]
    lights: Sequence[Light] = (Light((0.5, -0.4, 1.0), 0.55), Light((-0.9, 0.2, 0.6), 0.2))
    ambient: float = 0.25
    background: float = 90.0


def render_solids(
    calibration: Calibration,
    base_from_tool: PoseLike,
    scene: SolidScene,
    *,
    samples: int = 32,
    stride: int = 1,
    **sensor: Unpack[SensorOptions],
) -> UInt8[np.ndarray, "rows columns"]:
    """Return the picture of solid objects from one robot pose.

    Args:
        calibration: camera and mount; surfaces are in its world's frame.
        base_from_tool: the true robot pose, a single one.
        scene: surfaces and lights.
        samples: number of rays in a pixel at an edge.
        stride: step between the pixels that are sampled first, as in `scene_brightness`.
        sensor: `blur`, `noise`, `exposure` and `seed`, as for `sensor_picture`.

    Raises:
        ImportError: trimesh or embreex is not installed.
        ValueError: no surfaces, or several poses.
    """
    brightness = scene_brightness(calibration, base_from_tool, scene, samples, stride)
    return sensor_picture(brightness, **sensor)


def scene_brightness(
    calibration: Calibration,
    base_from_tool: PoseLike,
    scene: SolidScene,
    samples: int = 32,
    stride: int = 1,
) -> Float[np.ndarray, "rows columns"]:
    """Return the mean brightness over each pixel, grey levels, before the lens's blur.

    With a stride only every stride-th pixel is sampled first, and the brightness is interpolated
    where neighbours differ little: large pictures take a fraction of the time, but details smaller
    than the stride and far from any edge are lost.
    """
    camera_from_world = host_matrices(calibration.camera_from_world(as_se3(base_from_tool)))
    if camera_from_world.shape != (4, 4):
        raise ValueError(f"base_from_tool: expected one pose, found {camera_from_world.shape[:-2]}")
    # One ray per pixel shows where edges are; only there more rays are needed.
    brightness_along = _ray_brightness(scene, calibration.camera, np.linalg.inv(camera_from_world))
    width, rows = calibration.camera.image_size
    pixels = np.stack(np.meshgrid(np.arange(float(width)), np.arange(float(rows))), axis=-1)
    if stride > 1:
        picture = _coarse_to_fine(brightness_along, pixels, stride)
    else:
        picture = brightness_along(pixels.reshape(-1, 2)).reshape(rows, width)
    at_edge = _at_edges(picture)
    subpixels = pixels[at_edge][:, None] + _sample_offsets(samples)
    picture[at_edge] = brightness_along(subpixels.reshape(-1, 2)).reshape(-1, samples).mean(axis=1)
    return picture


def _coarse_to_fine(
    brightness_along: Callable[[Float[np.ndarray, "pixels 2"]], Float[np.ndarray, "pixels"]],
    pixels: Float[np.ndarray, "rows columns 2"],
    stride: int,
) -> Float[np.ndarray, "rows columns"]:
    """Return the brightness of one ray through each pixel, interpolated where it varies little."""
    rows, width = pixels.shape[:2]
    # The coarse pixels reach the last row and column, or just beyond.
    v, u = (np.arange(0.0, n - 1 + stride, stride) for n in (rows, width))
    grid = np.stack(np.meshgrid(u, v), axis=-1)
    coarse = brightness_along(grid.reshape(-1, 2)).reshape(len(v), len(u))
    x, y = ((pixels[..., k] / stride).astype(np.float32) for k in (0, 1))
    picture = cv2.remap(coarse, x, y, cv2.INTER_LINEAR)
    # Around a coarse pixel that differs from a neighbour all pixels are sampled.
    uneven = _at_edges(coarse).astype(np.uint8)
    fine = cv2.remap(uneven, x, y, cv2.INTER_NEAREST) > 0
    picture[fine] = brightness_along(pixels[fine])
    return picture


def _at_edges(picture: Float[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "rows columns"]:
    """Return which pixels differ from one of their eight neighbours by more than a smooth step."""
    # The largest minus the smallest value of each neighbourhood.
    square = np.ones((3, 3), np.uint8)
    return cv2.dilate(picture, square) - cv2.erode(picture, square) > MAX_SMOOTH_STEP


def _sample_offsets(samples: int) -> Float[np.ndarray, "samples 2"]:
    """Return points spread evenly over a pixel about its centre, px.

    They are Hammersley's: no two share a row or a column, so that an edge of any direction divides
    them nearly in the ratio of the areas, while a square grid would err along its own axes.
    """
    index = np.arange(samples)
    # The radical inverse in base 2 mirrors the index's bits about the binary point.
    bits = 1 << np.arange(16)
    mirrored = ((index[:, None] // bits % 2) * 0.5 / bits).sum(axis=1)
    return np.column_stack([(index + 0.5) / samples, mirrored + 0.5 / samples]) - 0.5


def _ray_brightness(
    scene: SolidScene, camera: Camera, world_from_camera: Float[np.ndarray, "4 4"]
) -> Callable[[Float[np.ndarray, "pixels 2"]], Float[np.ndarray, "pixels"]]:
    """Return a function that casts a ray from each pixel and returns the brightness it hits."""
    if not scene.surfaces:
        raise ValueError("scene: expected at least one surface, found none")
    counts = [len(surface.vertices) for surface in scene.surfaces]
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    parts = [s.triangles + start for s, start in zip(scene.surfaces, starts, strict=True)]
    # One mesh for all surfaces, so that each occludes the others and throws shadows on them.
    caster = RayCaster(
        np.concatenate([surface.vertices for surface in scene.surfaces]), np.concatenate(parts)
    )
    surface_of = np.repeat(np.arange(len(parts)), [len(part) for part in parts])

    def batch_brightness(pixels: np.ndarray) -> np.ndarray:
        rays, valid = in_batches(lambda batch: _unproject(camera, batch), pixels, RAYS_PER_BATCH)
        directions = np.where(valid[:, None], rays, [0.0, 0.0, 1.0]) @ world_from_camera[:3, :3].T
        # Pixels without a ray get an arbitrary one, and count as a miss below.
        hits = caster.first_hits(world_from_camera[:3, 3], directions)
        surface = np.where(valid & (hits.triangle != MISSED), surface_of[hits.triangle], MISSED)
        return _shade(scene, caster, hits, surface)

    def brightness_along(pixels: np.ndarray) -> np.ndarray:
        splits = range(RAYS_PER_BATCH, len(pixels), RAYS_PER_BATCH)
        return np.concatenate([batch_brightness(part) for part in np.split(pixels, splits)])

    return brightness_along


@compiled_optimised
def _unproject(
    camera: Camera, pixels: Float[Array, "pixels 2"]
) -> tuple[Float[Array, "pixels 3"], Bool[Array, "pixels"]]:
    """Return the rays of pixels in the camera's frame, compiled for one batch."""
    return camera.unproject(pixels)


def _shade(
    scene: SolidScene, caster: RayCaster, hits: Hits, surface: Int[np.ndarray, "rays"]
) -> Float[np.ndarray, "rays"]:
    """Return the brightness of hits on matt surfaces (Lambert's law)."""
    # brightness = white * albedo * (ambient + sum over lights of strength * max(n . l, 0)), without
    # the lights that something hides.
    light = np.full(len(surface), scene.ambient)
    # A surface that faces away from a light is dark, without testing for shadows.
    for direction, strength in scene.lights:
        unit = np.array(direction) / np.linalg.norm(direction)
        cosine = hits.normals @ unit
        lit = np.nonzero((surface != MISSED) & (cosine > 0.0))[0]
        hidden = caster.is_hidden(hits.points[lit], hits.normals[lit], unit)
        light[lit] += np.where(hidden, 0.0, strength * cosine[lit])
    brightness = np.full(len(surface), scene.background)
    for k, part in enumerate(scene.surfaces):
        on_surface = surface == k
        brightness[on_surface] = (
            WHITE_LEVEL * part.texture(hits.points[on_surface]) * light[on_surface]
        )
    return brightness
