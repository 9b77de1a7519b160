"""From where a target was seen: what a calibration knows about, and which side of the target.

Of flat boards the frame says little: with z into the board, as OpenCV has it, the camera stands
where z is negative. So the side is taken from the views, and so is how far they reach.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_SIDES = {"+z": 1.0, "-z": -1.0, "both": 0.0}

LEAST_REACH = 0.1
"""Of the distance to the target: views that all stand in one place know that much about them."""


def _number(value: object) -> Float[Array, "..."]:
    return jnp.asarray(value, dtype=float)


class ViewedRegion(eqx.Module):
    """Where cameras stood, in the target's (= world) frame.

    Attributes:
        side: 1 where all cameras stood on the side of +z of the target, -1 of -z, 0 on both.
        plane: z of the target's plane; of points at several heights the farthest, m.
        middle: mean of the cameras' centres, m.
        reach: distance of the farthest camera from that mean, m.
        distance: least and greatest, from the cameras to the middle of the target, m.
        lowest_tool: least height of the tool's origin over the target's plane, on the side of the
            cameras, m; infinite where the target is on the tool, or was seen from both sides.
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
        """The region of cameras and tools at these places.

        Args:
            cameras: their centres in the target's frame, m.
            points: of the target in its own frame, in true size, m.
            tools: origins of the tool in the target's frame, m; None where the target is on it.
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
        """Whether the cameras stood on the side of +z; None where they stood on both sides."""
        return None if float(self.side) == 0.0 else float(self.side) > 0.0

    def height(self, place: Float[Array, "*views 3"] | np.ndarray) -> Float[Array, "*views"]:
        """Height of places over the target's plane, on the side that was seen, m."""
        return self.side * (place[..., 2] - self.plane)

    def extent(self, cameras: Float[Array, "*views 3"] | np.ndarray) -> Float[Array, "*views"]:
        """How far from the middle cameras stand, in multiples of the farthest that was used."""
        offset = cameras - jnp.broadcast_to(self.middle, cameras.shape)
        return jnp.linalg.norm(offset, axis=-1) / self.reach


def region_to_dict(region: ViewedRegion) -> dict[str, Any]:
    """Plain numbers in metres with their names, as `calibration.yaml` has them."""
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
    """The inverse of `region_to_dict`, of content that `schemas.calibration` has checked."""
    lowest = content.get("lowest_tool")
    return ViewedRegion(
        side=_SIDES[content["side"]],
        plane=content["plane"],
        middle=content["middle"],
        reach=content["reach"],
        distance=content["distance"],
        lowest_tool=np.inf if lowest is None else lowest,
    )
