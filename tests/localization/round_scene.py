"""A washer and a pipe on a table, in two rendered pictures, for the tests of round parts.

The pictures show parts with 96 sides, as good as round; the models have 24.
`python tests/localization/round_scene.py` renders them again.
"""

import dataclasses
import functools
from pathlib import Path

import cv2
import numpy as np
from seen_scene import CALIBRATION, base_from_tool, placed
from solids import drilled

from smartview_jax.modeling import find_symmetry
from smartview_jax.simulation import SolidScene, Surface, matt, render_solids, speckled

PICTURES = [Path(__file__).parent / "data" / f"round_{view}.png" for view in range(2)]
SIDES = 24
SIZES = {"washer": (0.022, 0.4), "pipe": (0.013, 2.4)}
POSES = [placed(-0.03, 0.0, 0.4), placed(0.04, 0.01, 1.2)]


def part(name, sides=SIDES):
    radius, height = SIZES[name]
    return drilled(sides, sides, radius, height)


@functools.cache
def models():
    """The washer and the pipe."""
    return [
        dataclasses.replace(part(name), name=name, symmetry=find_symmetry(part(name)))
        for name in SIZES
    ]


def pictures():
    return [np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)) for path in PICTURES]


def render():
    """Write the pictures."""
    from smartview_jax.io import to_trimesh

    surfaces = [Surface.of_plane(0.5, matt(0.3))]
    for name, pose in zip(SIZES, POSES, strict=True):
        mesh = to_trimesh(part(name, 96))
        # Earcut makes triangles without area where corners are in line.
        triangles = np.asarray(mesh.faces)[mesh.area_faces > 1e-12]
        vertices = np.asarray(mesh.vertices) @ pose[:3, :3].T + pose[:3, 3]
        surfaces.append(Surface(vertices, triangles, speckled(0.7, 0.02, 0.003)))
    for path, pose in zip(PICTURES, base_from_tool(), strict=True):
        scene = SolidScene(surfaces)
        cv2.imwrite(str(path), render_solids(CALIBRATION, pose, scene, exposure=1.2, samples=8))


if __name__ == "__main__":
    render()
