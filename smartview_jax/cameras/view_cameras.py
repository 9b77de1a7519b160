"""Project points in views that different cameras took, as one camera projects in its views."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from ..runtime.array_namespace import to_device
from ..runtime.compilation import compiled
from ..runtime.padding import repeat_last
from .camera import Camera


class ViewCameras(eqx.Module):
    """The cameras of several views; programs take it in place of a camera that took all views.

    Arrays of points and pixels have a first axis for the views. A program that goes through the
    views by `jax.vmap`, with `camera_axes`, sees the camera of one view, without that axis.

    Attributes:
        cameras: the different cameras.
        index: which of them took each view.
    """

    cameras: tuple[Camera, ...]
    index: Int[Array, "*views"]

    @classmethod
    def of(cls, cameras: Sequence[Camera], index: Int[np.ndarray, "views"]) -> "ViewCameras":
        """Return the cameras of views, given which of them took each."""
        return cls(tuple(cameras), to_device(np.asarray(index)))

    @property
    def image_size(self) -> Int[Array, "*views 2"]:
        """The width and height of each view's picture, px."""
        return jnp.asarray([camera.image_size for camera in self.cameras])[self.index]

    @property
    def alpha_u(self) -> Float[Array, "*views"]:
        """The horizontal focal length over the pixel pitch of each view's camera, px."""
        return jnp.stack([camera.alpha_u for camera in self.cameras])[self.index]

    @property
    def alpha_v(self) -> Float[Array, "*views"]:
        """The vertical focal length over the pixel pitch of each view's camera, px."""
        return jnp.stack([camera.alpha_v for camera in self.cameras])[self.index]

    def project(
        self, points: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        """Return the pixels of points in each view's camera frame; as `Camera.project`."""
        # Every lens maps a point on the optical axis.
        on_axis = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), (*self.index.shape, 3))
        return self._by_kind(Camera.project, points, on_axis)

    def unproject(
        self, pixels: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 3"], Bool[Array, "*batch"]]:
        """Return the unit rays of pixels in each view's camera frame; as `Camera.unproject`."""
        centres = jnp.stack([jnp.stack([camera.u0, camera.v0]) for camera in self.cameras])
        return self._by_kind(Camera.unproject, pixels, centres[self.index])

    def _by_kind(
        self,
        method: Callable[[Camera, Array], tuple[Array, Array]],
        given: Float[Array, "*batch k"],
        harmless: Float[Array, "*views k"],
    ) -> tuple[Float[Array, "*batch n"], Bool[Array, "*batch"]]:
        """Return a method's results for each view by the camera that took it.

        Args:
            method: of a camera, for the points or pixels of one view.
            given: points or pixels of all views.
            harmless: for each view's camera, one of them that every lens can map.
        """
        if self.index.ndim:
            method = jax.vmap(method)
        views = self.index.shape
        inner = (1,) * (given.ndim - 1 - len(views))
        filler = harmless.reshape(*views, *inner, -1)
        values, valid = None, None
        for numbers in self._kinds():
            position = np.zeros(len(self.cameras), dtype=int)
            position[numbers] = np.arange(len(numbers))
            is_own = np.isin(np.arange(len(self.cameras)), numbers)
            of_kind = jnp.asarray(is_own)[self.index].reshape(*views, *inner)
            camera = self._stacked(numbers, jnp.asarray(position)[self.index])
            # Other views' points are replaced: where a lens has no value, its derivative may be
            # NaN, which no later selection removes.
            results, is_valid = method(camera, jnp.where(of_kind[..., None], given, filler))
            values = results if values is None else jnp.where(of_kind[..., None], results, values)
            valid = is_valid if valid is None else jnp.where(of_kind, is_valid, valid)
        assert values is not None
        assert valid is not None
        return values, valid

    def _kinds(self) -> list[list[int]]:
        """Return the numbers of the cameras of each kind of lens; one program serves a kind."""
        kinds: dict[Any, list[int]] = {}
        for k, camera in enumerate(self.cameras):
            shapes = tuple(np.shape(leaf) for leaf in jax.tree.leaves(camera))
            kinds.setdefault((jax.tree.structure(camera.lens), shapes), []).append(k)
        return list(kinds.values())

    def _stacked(self, numbers: Sequence[int], position: Int[Array, "*views"]) -> Camera:
        """Return the cameras of views, each at a position among some cameras of one kind."""
        # Their pictures' sizes may differ, which no projection asks for.
        structure = jax.tree.structure(self.cameras[numbers[0]])
        leaves = [jax.tree.leaves(self.cameras[k]) for k in numbers]
        stacked = [jnp.stack(same)[position] for same in zip(*leaves, strict=True)]
        return jax.tree.unflatten(structure, stacked)


AnyCamera = Camera | ViewCameras
"""The camera of all views, or the cameras of the views."""


def camera_axes(camera: AnyCamera) -> Any:
    """Return the entry of `jax.vmap`'s `in_axes` with which a function sees each view's camera."""
    if isinstance(camera, Camera):
        return None
    return jax.tree.map(lambda leaf: 0 if leaf is camera.index else None, camera)


def cameras_for(camera: AnyCamera, views: int) -> AnyCamera:
    """Return the cameras of padded views: the last view's camera is repeated."""
    if isinstance(camera, Camera):
        return camera
    return ViewCameras(camera.cameras, to_device(repeat_last(np.asarray(camera.index), views)))


def cameras_of_views(camera: AnyCamera, views: int) -> tuple[Camera, ...]:
    """Return the camera of each view."""
    if isinstance(camera, Camera):
        return (camera,) * views
    return tuple(camera.cameras[k] for k in np.asarray(camera.index))


def distinct_cameras(camera: AnyCamera) -> tuple[Camera, ...]:
    """Return the different cameras; only one, unless there are several."""
    return (camera,) if isinstance(camera, Camera) else camera.cameras


def with_cameras(camera: AnyCamera, cameras: Sequence[Camera]) -> AnyCamera:
    """Return the views' cameras with others in the place of `distinct_cameras`."""
    return cameras[0] if isinstance(camera, Camera) else ViewCameras(tuple(cameras), camera.index)


def ravelled_cameras(
    camera: AnyCamera,
) -> tuple[Float[Array, "numbers"], Callable[[Array], AnyCamera]]:
    """Return the parameters of all cameras as one vector, and the function that replaces them."""
    if isinstance(camera, Camera):
        return ravel_pytree(camera)
    numbers, rebuild = ravel_pytree(camera.cameras)
    return numbers, lambda changed: ViewCameras(rebuild(changed), camera.index)


def moved_cameras(camera: AnyCamera, change: Float[np.ndarray, "numbers"]) -> AnyCamera:
    """Return the cameras with a change added to their parameters, in the order of their leaves."""
    leaves, structure = jax.tree.flatten(distinct_cameras(camera))
    sizes = [np.size(leaf) for leaf in leaves]
    parts = np.split(change, np.cumsum(sizes)[:-1])
    moved = [
        to_device(np.asarray(leaf) + part.reshape(np.shape(leaf)))
        for leaf, part in zip(leaves, parts, strict=True)
    ]
    return with_cameras(camera, jax.tree.unflatten(structure, moved))


@compiled
def unit_rays(
    camera: AnyCamera, pixels: Float[Array, "*pixels 2"]
) -> tuple[Float[Array, "*pixels 3"], Bool[Array, "*pixels"]]:
    """Return the rays of pixels in the camera frame, and whether the lens is valid there.

    It is one program; operation by operation it would be some forty.
    """
    return camera.unproject(pixels)
