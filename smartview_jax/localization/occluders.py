"""Predict what stands before an object in views that were not taken: walls, and other objects.

Every ray from a camera's centre to a point of a wireframe is cast through the faces of what is
known to be there, as a model's own hidden lines are found.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..runtime.array_namespace import to_device
from ..runtime.compilation import compiled_optimised
from ..runtime.padding import power_of_two_from
from .distinct_poses import in_one_place
from .edge_lines import HIDING_DEPTH
from .localization import Localization
from .prediction import faces_before, triangle_crossings
from .wireframe import MIN_TRIANGLES, Wireframe


class Occluder(NamedTuple):
    """Faces that stand in the world and hide what is behind them.

    Attributes:
        triangles: of the faces, in the world, m.
        triangle_faces: which face each triangle is part of, as of a `Wireframe`; None where each
            hides by itself.
    """

    triangles: Float[np.ndarray, "T 3 3"]
    triangle_faces: Bool[np.ndarray, "T F"] | None

    @classmethod
    def of_triangles(cls, triangles: Float[np.ndarray, "T 3 3"]) -> "Occluder":
        """Return triangles, their number rounded up to one that programs are compiled for."""
        size = max(MIN_TRIANGLES, power_of_two_from(len(triangles)))
        # What was added has no area, so that no ray passes through it.
        padded = np.pad(triangles, ((0, size - len(triangles)), (0, 0), (0, 0)))
        return cls(padded, None)

    @classmethod
    def of_object(cls, one: Localization) -> "Occluder":
        """Return the faces of an object where it was found."""
        wireframe, pose = Wireframe.of(one.model), one.world_from_object
        in_world = np.asarray(wireframe.triangles) @ pose[:3, :3].T + pose[:3, 3]
        return cls(in_world, np.asarray(wireframe.triangle_faces))


def leading(localizations: Sequence[Localization]) -> list[Localization]:
    """Return the first localization at each place, of those that are not rejected."""
    kept: list[Localization] = []
    for one in localizations:
        if one.verdict.decision != "rejected" and not any(_one_place(one, other) for other in kept):
            kept.append(one)
    return kept


def occluders_beside(
    one: Localization,
    others: Sequence[Localization],
    triangles: Float[np.ndarray, "triangles 3 3"],
) -> list[Occluder]:
    """Return what may hide an object: known triangles, and objects that are elsewhere."""
    walls = [Occluder.of_triangles(triangles)] if len(triangles) else []
    beside = [other for other in others if not _one_place(one, other)]
    return walls + [Occluder.of_object(other) for other in beside if other.model.faces]


def hidden_in_views(
    occluders: Sequence[Occluder],
    centres: Float[np.ndarray, "views 3"],
    points: Float[np.ndarray, "S 3"],
) -> Bool[np.ndarray, "views S"]:
    """Return which points are behind something that stands there, seen from cameras' centres.

    Args:
        occluders: in the world.
        centres: of the cameras, in the world, m.
        points: in the world, m.
    """
    hidden = np.zeros((len(centres), len(points)), dtype=bool)
    on_device = to_device(centres), to_device(points)
    for one in occluders:
        owners = None if one.triangle_faces is None else to_device(one.triangle_faces)
        hidden |= np.asarray(_are_behind(to_device(one.triangles), owners, *on_device))
    return hidden


@compiled_optimised
def _are_behind(
    triangles: Float[Array, "T 3 3"],
    triangle_faces: Bool[Array, "T F"] | None,
    centres: Float[Array, "views 3"],
    points: Float[Array, "S 3"],
) -> Bool[Array, "views S"]:
    """Return which points are behind faces, by the same margin as in pictures that were taken."""
    last = jnp.full(len(points), 1.0 - HIDING_DEPTH)

    def from_centre(centre: Float[Array, "3"]) -> Bool[Array, "S"]:
        if triangle_faces is None:
            return (triangle_crossings(triangles, centre, points, last) != 0.0).any(axis=1)
        return faces_before(triangles, triangle_faces, centre, points, last).any(axis=1)

    return jax.vmap(from_centre)(centres)


def _one_place(one: Localization, other: Localization) -> bool:
    """Return whether two localizations are of one place."""
    return in_one_place(one.model, one.world_from_object, other.model, other.world_from_object)
