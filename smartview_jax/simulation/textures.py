"""Define the albedo of surfaces: procedural textures, which are sharp at every distance.

A texture is a function of points of a surface, in the surface's own frame, that returns the albedo:
the fraction of the light that a matt surface reflects, from 0 (black) to 1 (white).
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

Texture = Callable[[Float[np.ndarray, "points 3"]], Float[np.ndarray, "points"]]
"""A function that returns the albedo of surface points (m)."""

LATTICE_SIZE = 32
"""Number of random values per axis after which a speckled texture repeats."""


def matt(albedo: float) -> Texture:
    """Return the texture of a surface with a uniform albedo."""
    return lambda points: np.full(len(points), albedo)


def speckled(albedo: float, contrast: float, grain: float, seed: int = 0) -> Texture:
    """Return a smooth random texture, as of cast metal or cardboard.

    Args:
        albedo: its mean.
        contrast: largest deviation from the mean.
        grain: distance over which it changes, m.
    """
    values = np.random.default_rng(seed).uniform(-1.0, 1.0, (LATTICE_SIZE,) * 3)

    def texture(points: np.ndarray) -> np.ndarray:
        # Values at the corners of a lattice, interpolated with s = 3 t^2 - 2 t^3, which is smooth
        # at the cells' borders.
        cell = np.floor(points / grain).astype(int)
        t = points / grain - cell
        s = t * t * (3.0 - 2.0 * t)
        total = np.zeros(len(points))
        for corner in np.ndindex(2, 2, 2):
            weight = np.prod(np.where(corner, s, 1.0 - s), axis=1)
            total += weight * values[tuple(((cell + corner) % LATTICE_SIZE).T)]
        return np.clip(albedo + contrast * total, 0.0, 1.0)

    return texture


def labelled(ground: Texture, count: int, size: float, extent: float, seed: int = 0) -> Texture:
    """Return a texture with dark and light rectangles stuck on it, like labels and scraps of paper.

    Each rectangle is the intersection of a box, turned about z, with the surface: a rectangle on a
    plane of constant z, and a stripe on an upright face.

    Args:
        ground: the texture below them.
        count: number of rectangles.
        size: their largest length, m.
        extent: they are centred within this distance of the origin, along x and y, m.
    """
    rng = np.random.default_rng(seed)
    centres = rng.uniform(-extent, extent, (count, 2))
    half = 0.5 * size * rng.uniform(0.2, 1.0, (count, 2))
    angles, albedos = rng.uniform(0.0, np.pi, count), rng.uniform(0.05, 0.95, count)

    def texture(points: np.ndarray) -> np.ndarray:
        albedo = ground(points)
        # Later rectangles lie on earlier ones.
        for centre, extents, angle, level in zip(centres, half, angles, albedos, strict=True):
            x, y = (points[:, :2] - centre).T
            c, s = np.cos(angle), np.sin(angle)
            # Coordinates along the rectangle's own axes.
            inside = (np.abs(c * x + s * y) < extents[0]) & (np.abs(c * y - s * x) < extents[1])
            albedo = np.where(inside, level, albedo)
        return albedo

    return texture
