"""Describe the objects in a cell, and cut them into convex parts for the physics."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from ...argument_checks import require_readable
from ...geometry import host_poses
from ..polyhedra import Polyhedron, face_normal, loop_pairs
from ..textures import Texture, speckled

FLATNESS = 1e-7
"""Largest distance of a point from a plane to count as on it, over the object's extent."""

MAX_OBJECT_SIZE = 1.0
"""Largest extent of an object, m; a larger one was probably given in another unit."""


@dataclasses.dataclass(frozen=True, eq=False)
class CellObject:
    """A rigid object that falls, rests and is grasped.

    Convex polyhedra are supported, and prisms over any polygon, in any direction.

    Attributes:
        name: unique in the cell.
        solid: in the object's own frame, m.
        texture: albedo by points of the object's own frame.
        density: kg / m^3.
        friction: coefficient of sliding friction against anything.
    """

    name: str
    solid: Polyhedron
    texture: Texture = dataclasses.field(default_factory=lambda: speckled(0.7, 0.03, 0.003, seed=1))
    density: float = 600.0
    friction: float = 0.6

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ValueError: a name that no file could hold, vertices that are not finite or not in
                metres, a density or friction that is not positive, or a solid that cannot be cut;
                the message names the object.
        """
        require_readable("object", [self.name])
        vertices = self.solid.vertices
        extent = float(np.ptp(vertices, axis=0).max()) if len(vertices) else 0.0
        if not (np.isfinite(vertices).all() and 0.0 < extent <= MAX_OBJECT_SIZE):
            raise ValueError(
                f"object {self.name}: an extent of {extent:.4g} m; expected finite vertices and "
                f"at most {MAX_OBJECT_SIZE:g} m"
            )
        for name in ("density", "friction"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(
                    f"object {self.name}: {name} is {getattr(self, name)}; expected more than 0"
                )
        convex_parts(self.solid, self.name)

    @property
    def radius(self) -> float:
        """The distance of the farthest vertex from the middle of the vertices, m."""
        vertices = self.solid.vertices
        return float(np.linalg.norm(vertices - vertices.mean(axis=0), axis=1).max())


def convex_parts(solid: Polyhedron, name: str = "") -> tuple[Float[np.ndarray, "corners 3"], ...]:
    """Return the corners of convex parts that make up a solid."""
    if is_convex(solid):
        return (solid.vertices,)
    for face in solid.faces:
        axis = _prism_axis(solid, face)
        if axis is not None:
            bases = _convex_pieces(solid.vertices, face)
            corners = (solid.vertices[list(piece)] for piece in bases)
            return tuple(np.concatenate([base, base + axis]) for base in corners)
    raise ValueError(f"object {name}: neither convex nor a prism; give it as several objects")


def is_convex(solid: Polyhedron) -> bool:
    """Return whether no vertex is beyond the plane of any face."""
    tolerance = FLATNESS * float(np.ptp(solid.vertices, axis=0).max())
    for face in solid.faces:
        heights = (solid.vertices - solid.vertices[face[0]]) @ face_normal(solid.vertices, face)
        if heights.max() > tolerance:
            return False
    return True


def _prism_axis(solid: Polyhedron, base: tuple[int, ...]) -> Float[np.ndarray, "3"] | None:
    """Return the translation from a base of a prism to its other base, or None."""
    # A prism has as many vertices on either base.
    if 2 * len(base) != len(solid.vertices):
        return None
    others = solid.vertices[[k for k in range(len(solid.vertices)) if k not in base]]
    axis = others.mean(axis=0) - solid.vertices[list(base)].mean(axis=0)
    # Every corner of the base, moved by the axis, has to be a vertex of the other base.
    moved = solid.vertices[list(base)] + axis
    gaps = np.linalg.norm(moved[:, None] - others, axis=2).min(axis=1)
    return axis if gaps.max() < FLATNESS * np.ptp(solid.vertices, axis=0).max() else None


def _convex_pieces(
    vertices: Float[np.ndarray, "vertices 3"], face: tuple[int, ...]
) -> list[tuple[int, ...]]:
    """Return a face as convex pieces, by joining triangles (Hertel and Mehlhorn, 1983)."""
    normal = face_normal(vertices, face)
    # Triangles first; each pair that makes a convex piece is joined.
    pieces = [tuple(int(v) for v in t) for t in Polyhedron(vertices, (face,)).triangles]
    merged = True
    while merged:
        merged = False
        for first in pieces:
            for second in (piece for piece in pieces if piece is not first):
                joined = _joined(first, second)
                if joined is not None and _turns_left(vertices, joined, normal):
                    pieces = [p for p in pieces if p is not first and p is not second]
                    pieces.append(joined)
                    merged = True
                    break
            if merged:
                break
    return pieces


def _joined(first: tuple[int, ...], second: tuple[int, ...]) -> tuple[int, ...] | None:
    """Return the loop around two loops that share one side, or None."""
    for a, b in loop_pairs(first):
        if (b, a) in loop_pairs(second):
            # Once around the first from b to a, then around the second from a to b.
            start, other = first.index(b), second.index(a)
            around = first[start:] + first[:start]
            rest = second[other:] + second[:other]
            return around + rest[1:-1]
    return None


def _turns_left(
    vertices: Float[np.ndarray, "vertices 3"],
    loop: tuple[int, ...],
    normal: Float[np.ndarray, "3"],
) -> bool:
    """Return whether a loop is convex: it turns left, or goes straight on, at every corner."""
    sides = np.roll(vertices[list(loop)], -1, axis=0) - vertices[list(loop)]
    turns = np.cross(np.roll(sides, 1, axis=0), sides) @ normal
    lengths = np.linalg.norm(sides, axis=1)
    return bool((turns > -FLATNESS * lengths * np.roll(lengths, 1)).all())


class BoxShape(NamedTuple):
    """A box at any pose.

    Attributes:
        pose: pose of the box's own frame, with axes along its edges and origin in its middle, m.
        size: along its axes, m.
    """

    pose: Float[np.ndarray, "4 4"]
    size: Float[np.ndarray, "3"]


def as_box(corners: Float[np.ndarray, "corners 3"]) -> BoxShape | None:
    """Return the box that has these corners, or None if they are of another shape."""
    if len(corners) != 8:
        return None
    # The volume distinguishes a box from other shapes with three right angles at a corner.
    hull = ConvexHull(corners)
    # The edges from one corner are its shortest three perpendicular offsets.
    offsets = corners[1:] - corners[0]
    offsets = offsets[np.argsort(np.linalg.norm(offsets, axis=1))]
    chosen: list[np.ndarray] = []
    tolerance = FLATNESS * float(np.ptp(corners, axis=0).max()) ** 2
    for offset in offsets:
        if all(abs(offset @ edge) < tolerance for edge in chosen) and len(chosen) < 3:
            chosen.append(offset)
    if len(chosen) < 3:
        return None
    size = np.linalg.norm(chosen, axis=1)
    # A box fills the product of its edges.
    if abs(hull.volume - size.prod()) > 1e-6 * hull.volume:
        return None
    axes = np.array(chosen) / size[:, None]
    # Right-handed, whichever corner was the first.
    axes[2] = np.cross(axes[0], axes[1])
    return BoxShape(host_poses(axes.T, corners.mean(axis=0)), size)
