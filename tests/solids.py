"""Solids that several tests model, made by trimesh or written out by hand."""

import dataclasses
import itertools

import numpy as np

from smartview_jax.geometry import host_transformed
from smartview_jax.modeling import Face, ObjectModel, edges_of_faces


def box(x=0.06, y=0.04, z=0.03, **given):
    """A box in the first octant, its six faces outward and named."""
    corners = np.array([[i, j, k] for k in (0, 1) for j in (0, 1) for i in (0, 1)], float)
    loops = {
        "bottom": (0, 2, 3, 1),
        "top": (4, 5, 7, 6),
        "front": (0, 1, 5, 4),
        "back": (2, 6, 7, 3),
        "left": (0, 4, 6, 2),
        "right": (1, 3, 7, 5),
    }
    faces = tuple(Face(loop, name=name) for name, loop in loops.items())
    return ObjectModel(corners * [x, y, z], edges_of_faces(faces), faces, **given)


def moved(model, target_from_object):
    """A model's vertices in another frame."""
    vertices = host_transformed(target_from_object, model.vertices)
    return dataclasses.replace(model, vertices=vertices)


def prism(sides, radius=0.03, height=0.05):
    """A regular prism along z."""
    angles = 2.0 * np.pi * np.arange(sides) / sides
    ring = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    vertices = np.concatenate([np.column_stack([ring, np.full(sides, h)]) for h in (0.0, height)])
    walls = [(k, (k + 1) % sides, sides + (k + 1) % sides, sides + k) for k in range(sides)]
    ends = [tuple(range(sides))[::-1], tuple(range(sides, 2 * sides))]
    faces = tuple(Face(loop) for loop in [*walls, *ends])
    return ObjectModel(vertices, edges_of_faces(faces), faces)


def ring(sides, radius, height, turn=0.0):
    """The vertices of a regular polygon across z."""
    angles = turn + 2.0 * np.pi * np.arange(sides) / sides
    circle = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.column_stack([circle, np.full(sides, height)])


def drilled(outside, hole, radius=0.01, height=0.8):
    """A prism whose hole through the middle is a polygon too, as a mesh of a round one.

    The hole is half as wide; the height is over the radius. The walls show no edges from 18 on.
    """
    rings = [
        ring(sides, r, z)
        for sides, r in ((outside, radius), (hole, 0.5 * radius))
        for z in (0.0, height * radius)
    ]
    first = np.cumsum([0, *map(len, rings)])
    loops = [tuple(range(a, b)) for a, b in itertools.pairwise(first)]
    walls = [
        Face((low[k], low[k - len(low) + 1], high[k - len(low) + 1], high[k]))
        for low, high in (loops[:2], loops[:1:-1])
        for k in range(len(low))
    ]
    ends = [Face(loops[0][::-1], (loops[2],)), Face(loops[1], (loops[3][::-1],))]
    rims = [tuple(sorted(side)) for face in ends for side in face.directed_edges]
    upright = [(k, outside + k) for k in range(outside)] if outside < 18 else []
    vertices = np.concatenate(rings)
    return ObjectModel(vertices, np.array(sorted({*rims, *upright})), (*walls, *ends))
