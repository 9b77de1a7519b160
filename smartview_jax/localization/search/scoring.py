"""Score thousands of poses by how much of the visible wireframe lies on edges of the pictures.

Every sample of the wireframe is projected into all views and looked up in the distance map of its
direction. Chunks of poses run through one compiled program; single precision is far finer than the
maps. Memory does not grow with the number of poses.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped, UInt8

from ...features import DISTANCE_STEP, FAR, ORIENTATIONS, UNSEEN, PictureEvidence
from ...modeling import SeenViews
from ...runtime.array_namespace import to_device
from ...runtime.compilation import compiled_optimised
from ...runtime.padding import in_batches, power_of_two_from
from ..edges import Wireframe, centre_in_object, hidden_samples, samples_turned_away, with_outline

POSES_PER_CALL = 1024
"""Number of poses in one call of the compiled program."""

POSES_PER_CHUNK = 32
"""Number of poses computed at once: their samples fit in the processor's cache."""

MIN_MAP_POINTS = 4096
"""Smallest number of map points; larger ones are rounded up to a power of two."""


class SceneMaps(eqx.Module):
    """The edge maps of all views on the device; see `features.EdgeMaps`.

    Attributes:
        distances: in units of `DISTANCE_STEP` cells.
        nearest: index of the nearest point.
        points: in ideal coordinates, px, padded to the same number in all views.
        normals: unit normals of the points.
        camera_from_world: extrinsics of the views.
        origin: centre of the first cell of each view, px.
        cell_size, focal_length: of each view, px.
    """

    distances: UInt8[Array, "views orientations rows columns"]
    nearest: Int[Array, "views orientations rows columns"]
    points: Float[Array, "views points 2"]
    normals: Float[Array, "views points 2"]
    camera_from_world: Float[Array, "views 4 4"]
    origin: Float[Array, "views 2"]
    cell_size: Float[Array, "views"]
    focal_length: Float[Array, "views"]

    @classmethod
    def of(cls, evidence: Sequence[PictureEvidence], views: SeenViews) -> "SceneMaps":
        """Return the maps of the given views.

        Raises:
            ValueError: no views, or numbers of poses and pictures that differ.
        """
        if not len(evidence) or len(evidence) != len(views.camera_from_world):
            raise ValueError(
                f"evidence: expected one for each of {len(views.camera_from_world)} views, and at "
                f"least one; found {len(evidence)}"
            )
        maps = [view.maps for view in evidence]
        # Otherwise every new number of segments would compile all programs again.
        size = power_of_two_from(max(len(view.points) for view in maps), MIN_MAP_POINTS)

        def padded(parts: list[np.ndarray]) -> np.ndarray:
            return np.stack([np.pad(part, ((0, size - len(part)), (0, 0))) for part in parts])

        return cls(
            to_device(stacked_maps([view.distances for view in maps], UNSEEN)),
            to_device(stacked_maps([view.nearest for view in maps], 0)),
            *(
                to_device(np.asarray(array, np.float32))
                for array in (
                    padded([view.points for view in maps]),
                    padded([view.normals for view in maps]),
                    views.camera_from_world,
                    np.stack([view.origin for view in maps]),
                    np.array([view.cell_size for view in maps]),
                    np.array([view.focal_length for view in maps]),
                )
            ),
        )


def stacked_maps(
    maps: Sequence[Shaped[np.ndarray, "orientations _ _"]], value: int
) -> Shaped[np.ndarray, "views orientations rows columns"]:
    """Return the maps of pictures of any sizes, with a value where the smaller ones end."""
    rows, columns = np.max([view.shape[1:] for view in maps], axis=0)
    stacked = np.full((len(maps), len(maps[0]), rows, columns), value, maps[0].dtype)
    for view, of_view in enumerate(maps):
        stacked[view, :, : of_view.shape[1], : of_view.shape[2]] = of_view
    return stacked


class PoseScores(NamedTuple):
    """The lengths of wireframes at poses that agree with the pictures, all views together.

    Parts outside a picture count as visible and not explained, unless the whole object is outside.

    Attributes:
        visible_px: length of the wireframe that its own faces do not hide, px.
        explained_px: visible length that lies on picture edges of the same direction, px.
        support_px: the same with each part weighted by `1 - (distance / gate)^2`.
    """

    visible_px: Float[np.ndarray, "poses"]
    explained_px: Float[np.ndarray, "poses"]
    support_px: Float[np.ndarray, "poses"]

    @property
    def explained(self) -> Float[np.ndarray, "poses"]:
        """The explained share of the visible length; zero where nothing is visible."""
        return self.explained_px / np.maximum(self.visible_px, 1e-9)


def score_poses(
    maps: SceneMaps,
    wireframe: Wireframe,
    world_from_object: Float[np.ndarray, "poses 4 4"],
    gate: float,
    *,
    convex: bool = False,
) -> PoseScores:
    """Return how well each pose of a model agrees with the pictures.

    Args:
        maps: of the pictures.
        wireframe: of the model.
        world_from_object: the poses.
        gate: distance from an edge, px, beyond which a part of the wireframe is not explained.
        convex: whether to test only for edges between faces that face away, as if the object were
            convex; several times as fast.
    """
    single, limit = in_single_precision(wireframe), to_device(np.array(gate, np.float32))

    def of_batch(poses: Float[Array, "poses 4 4"]) -> Float[Array, "poses 3"]:
        return _score_poses(maps, single, poses, limit, convex)

    poses = world_from_object.astype(np.float32)
    return PoseScores(*in_batches(of_batch, poses, POSES_PER_CALL).astype(float).T)


def in_single_precision(tree: Any) -> Any:
    """Return a pytree with its double-precision arrays converted to single precision."""
    return jax.tree.map(
        lambda x: to_device(np.asarray(x, np.float32)) if x.dtype == np.float64 else x, tree
    )


@compiled_optimised
def _score_poses(
    maps: SceneMaps,
    wireframe: Wireframe,
    world_from_object: Float[Array, "poses 4 4"],
    gate: Float[Array, ""],
    convex: bool,
) -> Float[Array, "poses 3"]:
    """Return the three lengths of `PoseScores`."""

    def score(pose: Float[Array, "4 4"]) -> Float[Array, "3"]:
        views = range(len(maps.camera_from_world))
        lengths = [_score(maps, view, wireframe, pose, gate, convex) for view in views]
        return jnp.stack(lengths).sum(axis=0)

    # A loop over chunks: all poses at once would write every intermediate result to memory.
    chunks = world_from_object.reshape(-1, POSES_PER_CHUNK, 4, 4)
    return jax.lax.map(jax.vmap(score), chunks).reshape(-1, 3)


def _score(
    maps: SceneMaps,
    view: int,
    wireframe: Wireframe,
    world_from_object: Float[Array, "4 4"],
    gate: Float[Array, ""],
    convex: bool,
) -> Float[Array, "3"]:
    """Return the three lengths of one pose in one view."""
    samples = seen_samples(maps, view, wireframe, world_from_object, convex)
    # One flat index: a lookup with three indices takes 1.5 times as long.
    distance = maps.distances[view].reshape(-1)[samples.cell]
    inside = samples.inside & (distance != UNSEEN)
    squared = (distance.astype(jnp.float32) * (DISTANCE_STEP * maps.cell_size[view]) / gate) ** 2
    weight = jnp.where(inside & (distance < FAR), jnp.maximum(1.0 - squared, 0.0), 0.0)
    # A view that shows nothing of the object does not count.
    px = jnp.where(samples.visible & (samples.visible & inside).any(), samples.px, 0.0)
    lengths = [px.sum(), jnp.where(weight > 0.0, px, 0.0).sum(), (px * weight).sum()]
    return jnp.stack(lengths)


class SeenSamples(NamedTuple):
    """The samples of a wireframe in one view.

    Attributes:
        in_object, in_camera: in the object's and in the camera's frame, m.
        ideal: in ideal coordinates, px.
        px: lengths of the samples' parts of the edges, px.
        visible: whether they are in front of the camera and not hidden.
        inside: whether they are within the maps.
        cell: flat index into the maps of one view, in the map of the sample's direction.
    """

    in_object: Float[Array, "S 3"]
    in_camera: Float[Array, "S 3"]
    ideal: Float[Array, "S 2"]
    px: Float[Array, "S"]
    visible: Bool[Array, "S"]
    inside: Bool[Array, "S"]
    cell: Int[Array, "S"]


def seen_samples(
    maps: SceneMaps,
    view: int,
    wireframe: Wireframe,
    world_from_object: Float[Array, "4 4"],
    convex: bool = False,
) -> SeenSamples:
    """Return the samples of a wireframe in one view, with their cells in the maps."""
    pose = maps.camera_from_world[view] @ world_from_object
    R, t = pose[:3, :3], pose[:3, 3]
    centre = centre_in_object(pose)
    wireframe = with_outline(wireframe, centre)
    points, tangents = wireframe.samples @ R.T + t[None], wireframe.sample_tangents @ R.T
    x, y, z = points.T
    # Near the camera's plane an edge would be infinitely long in the picture.
    in_front = z > 1e-3 * jnp.abs(t[2])
    z = jnp.where(in_front, z, 1.0)
    f = maps.focal_length[view]
    ideal = f * jnp.stack([x / z, y / z], axis=1)
    # d(x / z) = (dx - x / z dz) / z
    slope = f * (tangents[:, :2] - ideal / f * tangents[:, 2:]) / z[:, None]
    scale = jnp.sqrt((slope**2).sum(axis=1))
    # Rounded to the nearest map; an edge and its reverse differ by half a turn and share a map.
    turns = jnp.arctan2(slope[:, 1], slope[:, 0]) * (ORIENTATIONS / jnp.pi)
    orientation = jnp.rint(turns).astype(jnp.int32) % ORIENTATIONS
    cell = jnp.rint((ideal - maps.origin[view][None]) / maps.cell_size[view])
    rows, columns = maps.distances.shape[-2:]
    inside = in_front & (cell >= 0.0).all(axis=1) & (cell[:, 0] < columns) & (cell[:, 1] < rows)
    # Samples outside have zero weight, so that any cell will do.
    column, row = jnp.where(inside[:, None], cell, 0.0).astype(jnp.int32).T
    is_hidden = samples_turned_away if convex else hidden_samples
    return SeenSamples(
        wireframe.samples,
        points,
        ideal,
        scale * wireframe.sample_lengths,
        in_front & ~is_hidden(wireframe, centre),
        inside,
        (orientation * rows + row) * columns + column,
    )
