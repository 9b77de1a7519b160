"""Describe the region of camera positions from which a calibration's views were taken.

Commands outside this region are extrapolations. The side of the target on which the cameras were is
computed from the views, because the frame of a flat board does not define it: with z into the
board, as in OpenCV, the cameras are where z is negative.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..runtime.array_namespace import as_float_array, to_device_together
from ..runtime.compilation import one_program
from ..runtime.modules import HostModule, module_of

_SIDES = {"+z": 1.0, "-z": -1.0, "both": 0.0}
"""Value of `ViewedRegion.side` for each name that a file may contain."""

MIN_RADIUS_FRACTION = 0.1
"""Smallest radius of a region, as a fraction of the mean distance to the target.

Views that were all taken from one position would otherwise have a radius of zero.
"""


class ViewedRegion(HostModule):
    """A region of camera positions in the target's (= world) frame.

    Attributes:
        side: 1 if all cameras were on the +z side of the target, -1 if all were on the -z side,
            0 otherwise.
        plane_z: z of the target's plane, m; for points at several heights, z of the points farthest
            from the cameras.
        centroid: mean of the camera centres, m.
        radius: distance of the farthest camera from the centroid, m, at least
            `MIN_RADIUS_FRACTION` times the mean distance to the target.
        distance_range: smallest and largest distance from the cameras to the mean of the target's
            points, m.
        min_tool_height: smallest height of the tool's origin over the target's plane, on the side
            of the cameras, m; infinite if the target is on the tool, or was seen from both sides.
    """

    side: Float[Array, ""] = eqx.field(converter=as_float_array)
    plane_z: Float[Array, ""] = eqx.field(converter=as_float_array)
    centroid: Float[Array, "3"] = eqx.field(converter=as_float_array)
    radius: Float[Array, ""] = eqx.field(converter=as_float_array)
    distance_range: Float[Array, "2"] = eqx.field(converter=as_float_array)
    min_tool_height: Float[Array, ""] = eqx.field(converter=as_float_array)

    @classmethod
    def from_positions(
        cls,
        cameras: Float[np.ndarray, "views 3"],
        points: Float[np.ndarray, "points 3"],
        tools: Float[np.ndarray, "views 3"] | None = None,
    ) -> "ViewedRegion":
        """Return the region of the given camera and tool positions.

        Args:
            cameras: camera centres in the target's frame, m.
            points: points of the target in its own frame, true to scale, m.
            tools: origins of the tool in the target's frame, m; None if the target is on the tool.
        """
        height, lower, upper = cameras[:, 2], points[:, 2].min(), points[:, 2].max()
        # A target with points at several heights has cameras on one side only if every camera is
        # beyond all of its points. The plane is at the points that are farthest from the cameras.
        side = 1.0 if (height > upper).all() else -1.0 if (height < lower).all() else 0.0
        centroid = cameras.mean(axis=0)
        # The mean as a product with a vector; NumPy's `mean` is twenty times slower for many
        # points.
        target_centre = np.full(len(points), 1.0 / len(points)) @ points
        distances = np.linalg.norm(cameras - target_centre, axis=1)
        radius = np.linalg.norm(cameras - centroid, axis=1).max()
        plane_z = lower if side > 0.0 else upper
        min_tool_height = np.inf
        if tools is not None and side != 0.0:
            min_tool_height = float((side * (tools[:, 2] - plane_z)).min())
        fields = {
            "side": side,
            "plane_z": plane_z,
            "centroid": centroid,
            "radius": max(float(radius), MIN_RADIUS_FRACTION * float(distances.mean())),
            "distance_range": np.array([distances.min(), distances.max()]),
            "min_tool_height": min_tool_height,
        }
        return module_of(cls, to_device_together(fields))

    @property
    def above(self) -> bool | None:
        """Whether the cameras were on the +z side of the target; None if on both sides."""
        return None if float(self.side) == 0.0 else float(self.side) > 0.0

    @one_program
    def height(self, positions: Float[Array, "*views 3"] | np.ndarray) -> Float[Array, "*views"]:
        """Return the height of positions over the target's plane, m, positive on the viewed side.

        It is zero for a target that was seen from both sides.

        Args:
            positions: positions in the target's frame, m.
        """
        return self.side * (positions[..., 2] - self.plane_z)

    @one_program
    def normalised_distance(
        self, cameras: Float[Array, "*views 3"] | np.ndarray
    ) -> Float[Array, "*views"]:
        """Return the distance of cameras from the centroid, relative to the views' own distances.

        The unit is the farthest distance of a view from the target, or `radius` if that is larger,
        because close views do not limit how far a camera may move around the target.

        Args:
            cameras: camera centres in the target's frame, m.
        """
        offset = cameras - jnp.broadcast_to(self.centroid, cameras.shape)
        return jnp.linalg.norm(offset, axis=-1) / jnp.maximum(self.radius, self.distance_range[1])


def region_to_dict(region: ViewedRegion) -> dict[str, Any]:
    """Return a region as plain numbers in metres by name, as in `calibration.yaml`."""
    # The keys of the file format are older than the names of the attributes.
    side = next(name for name, sign in _SIDES.items() if sign == float(region.side))
    content: dict[str, Any] = {
        "side": side,
        "plane": float(region.plane_z),
        "middle": np.asarray(region.centroid).tolist(),
        "reach": float(region.radius),
        "distance": np.asarray(region.distance_range).tolist(),
    }
    if np.isfinite(float(region.min_tool_height)):
        content["lowest_tool"] = float(region.min_tool_height)
    return content


def region_from_dict(content: dict[str, Any]) -> ViewedRegion:
    """Return the region that a mapping describes, the inverse of `region_to_dict`.

    Args:
        content: the mapping, already checked by `schemas.calibration`.
    """
    min_tool_height = content.get("lowest_tool")
    return ViewedRegion(
        side=_SIDES[content["side"]],
        plane_z=content["plane"],
        centroid=content["middle"],
        radius=content["reach"],
        distance_range=content["distance"],
        min_tool_height=np.inf if min_tool_height is None else min_tool_height,
    )
