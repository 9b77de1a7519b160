"""Predict occlusions in views that are not taken yet: by walls, and by other objects.

Every ray from a camera's centre to a point of a wireframe is tested against the faces of the known
obstacles, as a model's hidden lines are.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...geometry import host_transformed
from ...runtime.array_namespace import to_device
from ...runtime.compilation import compiled_optimised
from ...runtime.padding import power_of_two_from
from ..distinct_poses import surface_sigma
from ..edges import HIDING_DEPTH, MIN_TRIANGLES, Wireframe, faces_before, triangle_crossings
from ..judging import Localization
from ..solid_overlap import in_one_place, overlap_tolerance


class Occluder(NamedTuple):
    """Faces in the world that occlude whatever is behind them.

    Attributes:
        triangles: in the world, m.
        triangle_faces: the face that each triangle belongs to, as in `Wireframe`; None where each
            triangle occludes by itself.
    """

    triangles: Float[np.ndarray, "T 3 3"]
    triangle_faces: Bool[np.ndarray, "T F"] | None

    @classmethod
    def of_triangles(cls, triangles: Float[np.ndarray, "T 3 3"]) -> "Occluder":
        """Return triangles, padded to a number that programs are compiled for."""
        size = power_of_two_from(len(triangles), MIN_TRIANGLES)
        # Padded triangles have no area, so that no ray hits them.
        padded = np.pad(triangles, ((0, size - len(triangles)), (0, 0), (0, 0)))
        return cls(padded, None)

    @classmethod
    def of_object(cls, obj: Localization) -> "Occluder":
        """Return the faces of an object at its pose."""
        wireframe, pose = Wireframe.of(obj.model), obj.world_from_object
        in_world = host_transformed(pose, np.asarray(wireframe.triangles))
        return cls(in_world, np.asarray(wireframe.triangle_faces))


def leading(localizations: Sequence[Localization]) -> list[Localization]:
    """Return the first localization at each place that is not rejected."""
    kept: list[Localization] = []
    for result in localizations:
        if result.verdict.decision != "rejected" and not any(
            _one_place(result, other) for other in kept
        ):
            kept.append(result)
    return kept


def occluders_around(
    obj: Localization,
    others: Sequence[Localization],
    triangles: Float[np.ndarray, "triangles 3 3"],
) -> list[Occluder]:
    """Return what may occlude an object: known triangles, and objects at other places."""
    walls = [Occluder.of_triangles(triangles)] if len(triangles) else []
    neighbours = [other for other in others if not _one_place(obj, other)]
    return walls + [Occluder.of_object(other) for other in neighbours if other.model.faces]


def hidden_in_views(
    occluders: Sequence[Occluder],
    centres: Float[np.ndarray, "views 3"],
    points: Float[np.ndarray, "S 3"],
) -> Bool[np.ndarray, "views S"]:
    """Return which points are occluded, as seen from cameras' centres.

    Args:
        occluders: in the world.
        centres: of the cameras, in the world, m.
        points: in the world, m.
    """
    hidden = np.zeros((len(centres), len(points)), dtype=bool)
    on_device = to_device(centres), to_device(points)
    for occluder in occluders:
        owners = None if occluder.triangle_faces is None else to_device(occluder.triangle_faces)
        hidden |= np.asarray(_are_behind(to_device(occluder.triangles), owners, *on_device))
    return hidden


@compiled_optimised
def _are_behind(
    triangles: Float[Array, "T 3 3"],
    triangle_faces: Bool[Array, "T F"] | None,
    centres: Float[Array, "views 3"],
    points: Float[Array, "S 3"],
) -> Bool[Array, "views S"]:
    """Return which points are behind faces, by the same margin as in real pictures."""
    last = jnp.full(len(points), 1.0 - HIDING_DEPTH)

    def from_centre(centre: Float[Array, "3"]) -> Bool[Array, "S"]:
        if triangle_faces is None:
            return (triangle_crossings(triangles, centre, points, last) != 0.0).any(axis=1)
        return faces_before(triangles, triangle_faces, centre, points, last).any(axis=1)

    return jax.vmap(from_centre)(centres)


def _one_place(first: Localization, other: Localization) -> bool:
    """Return whether two localizations are at the same place."""
    sigmas = [surface_sigma(obj.model, obj.covariance) for obj in (first, other)]
    return in_one_place(
        first.model,
        first.world_from_object,
        other.model,
        other.world_from_object,
        overlap_tolerance(*sigmas),
    )
