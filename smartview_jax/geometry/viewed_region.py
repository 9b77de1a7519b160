"""Describe the region of camera positions from which a calibration's views were taken.

Commands outside this region are extrapolations. The side of the target on which the cameras were
is computed from the views, because the frame of a flat board does not show it: with z into the
board, as in OpenCV, the cameras are where z is negative.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_SIDES = {"+z": 1.0, "-z": -1.0, "both": 0.0}
"""Value of `ViewedRegion.side` for each name that a file may contain."""

LEAST_REACH = 0.1
"""Smallest reach of a region, as a fraction of the mean distance to the target.

Views that were all taken from one position would otherwise have a region of size zero.
"""


def _number(value: object) -> Float[Array, "..."]:
    """Return a value as a float array."""
    return jnp.asarray(value, dtype=float)


class ViewedRegion(eqx.Module):
    """A region of camera positions in the target's (= world) frame.

    Attributes:
        side: 1 if all cameras were on the +z side of the target, -1 if all were on the -z side,
            0 otherwise.
        plane: z of the target's plane, m; for points at several heights, z of those farthest from
            the cameras.
        middle: mean of the camera centres, m.
        reach: distance of the farthest camera from that mean, m.
        distance: smallest and largest distance from the cameras to the middle of the target, m.
        lowest_tool: smallest height of the tool's origin over the target's plane, on the side of
            the cameras, m; infinite if the target is on the tool, or was seen from both sides.
    """

    side: Float[Array, ""] = eqx.field(converter=_number)
    plane: Float[Array, ""] = eqx.field(converter=_number)
    middle: Float[Array, "3"] = eqx.field(converter=_number)
    reach: Float[Array, ""] = eqx.field(converter=_number)
    distance: Float[Array, "2"] = eqx.field(converter=_number)
    lowest_tool: Float[Array, ""] = eqx.field(converter=_number)

    @classmethod
    def of(
        cls,
        cameras: Float[np.ndarray, "views 3"],
        points: Float[np.ndarray, "points 3"],
        tools: Float[np.ndarray, "views 3"] | None = None,
    ) -> "ViewedRegion":
        """Return the region of the given camera and tool positions.

        Args:
            cameras: camera centres in the target's frame, m.
            points: points of the target in its own frame, in true size, m.
            tools: origins of the tool in the target's frame, m; None if the target is on the tool.
        """
        height, low, high = cameras[:, 2], points[:, 2].min(), points[:, 2].max()
        side = 1.0 if (height > high).all() else -1.0 if (height < low).all() else 0.0
        middle = cameras.mean(axis=0)
        away = np.linalg.norm(cameras - points.mean(axis=0), axis=1)
        reach = np.linalg.norm(cameras - middle, axis=1).max()
        plane = low if side > 0.0 else high
        lowest = np.inf
        if tools is not None and side != 0.0:
            lowest = float((side * (tools[:, 2] - plane)).min())
        return cls(
            side,
            plane,
            middle,
            max(float(reach), LEAST_REACH * float(away.mean())),
            np.array([away.min(), away.max()]),
            lowest,
        )

    @property
    def above(self) -> bool | None:
        """Whether the cameras were on the +z side of the target; None if on both sides."""
        return None if float(self.side) == 0.0 else float(self.side) > 0.0

    def height(self, place: Float[Array, "*views 3"] | np.ndarray) -> Float[Array, "*views"]:
        """Return the height of positions over the target's plane, m, positive on the viewed side.

        It is zero for a target that was seen from both sides.

        Args:
            place: positions in the target's frame, m.
        """
        return self.side * (place[..., 2] - self.plane)

    def extent(self, cameras: Float[Array, "*views 3"] | np.ndarray) -> Float[Array, "*views"]:
        """Return the distance of cameras from the middle, as a multiple of `reach`.

        Args:
            cameras: camera centres in the target's frame, m.
        """
        offset = cameras - jnp.broadcast_to(self.middle, cameras.shape)
        return jnp.linalg.norm(offset, axis=-1) / self.reach


def region_to_dict(region: ViewedRegion) -> dict[str, Any]:
    """Return a region as plain numbers in metres by name, as in `calibration.yaml`."""
    side = next(name for name, sign in _SIDES.items() if sign == float(region.side))
    content: dict[str, Any] = {
        "side": side,
        "plane": float(region.plane),
        "middle": np.asarray(region.middle).tolist(),
        "reach": float(region.reach),
        "distance": np.asarray(region.distance).tolist(),
    }
    if np.isfinite(float(region.lowest_tool)):
        content["lowest_tool"] = float(region.lowest_tool)
    return content


def region_from_dict(content: dict[str, Any]) -> ViewedRegion:
    """Return the region that a mapping describes, the inverse of `region_to_dict`.

    Args:
        content: the mapping, already checked by `schemas.calibration`.
    """
    lowest = content.get("lowest_tool")
    return ViewedRegion(
        side=_SIDES[content["side"]],
        plane=content["plane"],
        middle=content["middle"],
        reach=content["reach"],
        distance=content["distance"],
        lowest_tool=np.inf if lowest is None else lowest,
    )
