"""Describe a parallel-jaw gripper by the boxes it is made of.

The frame `gripper` is the frame of a grasp: z is the approach, x the direction along which the
fingers close, and the origin is the point between the fingertips. A robot reports and moves its
*tool* frame, which for most controllers is the flange: `tool_from_gripper` is the gripper's pose.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..geometry import check_rigid

MAX_GRIPPER_SIZE = 2.0
"""Largest dimension of a gripper, m: a larger one was given in another unit."""

BOX_CORNERS = np.array([[x, y, z] for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
"""The corners of a cube of unit size about the origin."""

BOX_TRIANGLES = np.array(
    [
        [0, 2, 3], [0, 3, 1],
        [4, 5, 7], [4, 7, 6],
        [0, 1, 5], [0, 5, 4],
        [2, 6, 7], [2, 7, 3],
        [0, 4, 6], [0, 6, 2],
        [1, 3, 7], [1, 7, 5],
    ]
)  # fmt: skip
"""The sides of `BOX_CORNERS` as triangles, counter-clockwise as seen from outside."""


class GripperBox(NamedTuple):
    """A part of a gripper: a box along the axes of the gripper's frame.

    Attributes:
        name: "palm", "left finger" (towards -x) or "right finger".
        centre: in the gripper's frame, m.
        size: along x, y and z, m.
    """

    name: str
    centre: Float[np.ndarray, "3"]
    size: Float[np.ndarray, "3"]

    @property
    def vertices(self) -> Float[np.ndarray, "8 3"]:
        """The corners, in the gripper's frame, m; their triangles are `BOX_TRIANGLES`."""
        return self.centre + BOX_CORNERS * self.size


def _flange_behind_the_palm() -> Float[np.ndarray, "4 4"]:
    """Return the default `tool_from_gripper`: the tool frame is at the back of the palm."""
    transform = np.eye(4)
    transform[2, 3] = 0.11
    return transform


@dataclasses.dataclass(frozen=True, eq=False)
class Gripper:
    """A gripper with two parallel jaws, which open symmetrically.

    Attributes:
        max_opening: largest distance between the fingers, m.
        finger_length: from the palm to the fingertips, along z, m.
        finger_width: across the closing direction, along y, m.
        finger_thickness: along the closing direction, m.
        palm: size of the body behind the fingers along x, y and z, m.
        tolerance: smallest room between a finger and the object, when the fingers are open, with
            which the gripper closes reliably, m.
        min_hold: smallest length of finger that has to be along the object to hold it, m.
        max_turn: largest angle between object and gripper that closing fingers straighten, rad.
        tool_from_gripper: pose of the gripper's frame in the tool's, 4x4, m; by default the tool
            frame is at the back of the palm, 0.11 m from the fingertips.

    For example:

        >>> gripper = sv.Gripper(max_opening=0.06, finger_length=0.04)
        >>> print(gripper.max_opening, gripper.tool_from_gripper[2, 3])
        0.06 0.11
    """

    max_opening: float = 0.08
    finger_length: float = 0.05
    finger_width: float = 0.016
    finger_thickness: float = 0.008
    palm: tuple[float, float, float] = (0.11, 0.05, 0.06)
    tolerance: float = 5e-4
    min_hold: float = 4e-3
    max_turn: float = float(np.deg2rad(15.0))
    tool_from_gripper: Float[np.ndarray, "4 4"] = dataclasses.field(
        default_factory=_flange_behind_the_palm
    )

    def __post_init__(self) -> None:
        """Check the dimensions.

        Raises:
            ValueError: a length that is not positive, not finite or not in metres, an angle that is
                not in radians, or a transform that is not rigid; the message names it.
        """
        lengths = {
            "max_opening": self.max_opening,
            "finger_length": self.finger_length,
            "finger_width": self.finger_width,
            "finger_thickness": self.finger_thickness,
            **{f"palm[{k}]": value for k, value in enumerate(self.palm)},
        }
        for name, value in lengths.items():
            if not 0.0 < value <= MAX_GRIPPER_SIZE:
                raise ValueError(
                    f"gripper: {name} is {value!r}; expected metres, more than 0 and at most "
                    f"{MAX_GRIPPER_SIZE:g}"
                )
        # These may be zero: an ideal gripper. More would leave nothing to grasp with.
        most = {
            "tolerance": (0.5 * self.max_opening, "m, half of the largest opening"),
            "min_hold": (self.finger_length, "m, the length of the fingers"),
            "max_turn": (0.5 * np.pi, "rad"),
        }
        for name, (limit, unit) in most.items():
            if not 0.0 <= getattr(self, name) <= limit:
                raise ValueError(
                    f"gripper: {name} is {getattr(self, name)!r}; expected 0 to {limit:.3g} {unit}"
                )
        pose = self.tool_from_gripper
        if pose.shape != (4, 4) or check_rigid(pose[None], ("tool_from_gripper",), 1e-5):
            raise ValueError("gripper: tool_from_gripper is no rigid 4x4 transform")
        if not np.abs(pose[:3, 3]).max() <= MAX_GRIPPER_SIZE:
            raise ValueError(
                f"gripper: tool_from_gripper: expected metres, up to {MAX_GRIPPER_SIZE:g}; found "
                f"{pose[:3, 3].tolist()}"
            )

    def boxes(self, opening: float) -> tuple[GripperBox, GripperBox, GripperBox]:
        """Return palm, left and right finger at an opening, m; one out of range is a ValueError."""
        if not 0.0 <= opening <= self.max_opening * (1.0 + 1e-9):
            raise ValueError(
                f"an opening of {1e3 * opening:.4g} mm; the gripper opens to "
                f"{1e3 * self.max_opening:.4g} mm"
            )
        # The fingers' inner faces are at x = -+opening / 2, their tips at z = 0.
        x = 0.5 * (opening + self.finger_thickness)
        finger = np.array([self.finger_thickness, self.finger_width, self.finger_length])
        middle, palm = -0.5 * self.finger_length, np.array(self.palm)
        behind = -self.finger_length - 0.5 * palm[2]
        return (
            GripperBox("palm", np.array([0.0, 0.0, behind]), palm),
            GripperBox("left finger", np.array([-x, 0.0, middle]), finger),
            GripperBox("right finger", np.array([x, 0.0, middle]), finger),
        )

    def mesh(self, opening: float) -> tuple[Float[np.ndarray, "24 3"], Int[np.ndarray, "36 3"]]:
        """Return vertices in the gripper's frame, m, and triangles of the gripper, for drawing."""
        boxes = self.boxes(opening)
        triangles = [BOX_TRIANGLES + len(BOX_CORNERS) * k for k in range(len(boxes))]
        return np.concatenate([box.vertices for box in boxes]), np.concatenate(triangles)
