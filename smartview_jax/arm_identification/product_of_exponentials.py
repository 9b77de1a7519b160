"""Predict poses of a target on an arm from its joint axes, and differentiate them.

The pose model is a product of exponentials,

    camera_from_target(q) = prod_k F_k exp(r_k q_k z_k) F_k^-1 @ home

with `F_k` a frame on joint axis k, `r_k` the gear ratio, and `z_k` the unit twist of a rotation
about, or a translation along, the z axis. It is computed by NumPy: an arm is identified from some
dozens of poses, in milliseconds, and a program for it would take seconds to compile.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..geometry import host_adjoints, host_exponentials

AXIS_TWISTS = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]])
"""The unit twist of a rotation about the z axis (row 0), and of a translation along it (row 1)."""

_AXIS_PARAMETERS = [0, 1, 3, 4]
"""The components of a frame's twist that change its z axis as a line."""


@dataclass(frozen=True)
class ProductOfExponentials:
    """A product of exponentials: an arm's joint axes, their ratios and the target pose at zero.

    Attributes:
        frames: frames whose z axes are the joint axes where all joints read zero, in the camera's
            frame.
        ratios: true joint motion per unit of its reading.
        home: the pose of the target where all joints read zero, in the camera's frame.
    """

    frames: Float[np.ndarray, "joints 4 4"]
    ratios: Float[np.ndarray, "joints"]
    home: Float[np.ndarray, "4 4"]

    def displaced(self, step: Float[np.ndarray, "parameters"]) -> "ProductOfExponentials":
        """Return the axes after a parameter step.

        The step has five numbers per joint (translation along x and y of the axis frame, rotation
        about x and y, change of the ratio), then the six of a twist of `home`. Translation along an
        axis and rotation about it do not change the axis, so they are no parameters.
        """
        per_joint = step[:-6].reshape(-1, 5)
        # F_k <- F_k exp((v_x, v_y, 0, w_x, w_y, 0)), r_k <- r_k + dr_k, home <- home exp(twist)
        twists = np.zeros((len(per_joint), 6))
        twists[:, _AXIS_PARAMETERS] = per_joint[:, :4]
        return ProductOfExponentials(
            self.frames @ host_exponentials(twists),
            self.ratios + per_joint[:, 4],
            self.home @ host_exponentials(step[-6:]),
        )

    def camera_from_target(
        self, joints: Float[np.ndarray, "views joints"], prismatic: tuple[bool, ...]
    ) -> Float[np.ndarray, "views 4 4"]:
        """Return the target's pose in the camera's frame at the given joint readings."""
        return self._targets_from_the_end(joints, prismatic)[0]

    def target_twists(
        self, joints: Float[np.ndarray, "views joints"], prismatic: tuple[bool, ...]
    ) -> Float[np.ndarray, "views 6 parameters"]:
        """Return the twists at the target by which the parameters of a step move it.

        For a small step d, the pose becomes `camera_from_target @ exp(twists @ d)`.
        """
        later = self._targets_from_the_end(joints, prismatic)[1:]
        motions = self._motions(joints, prismatic)
        identity, columns = np.eye(6), []
        for k, (frame, motion) in enumerate(zip(self.frames, motions, strict=True)):
            # F exp(x) M exp(-x) F^-1 S = F M F^-1 S exp(Ad(F^-1 S)^-1 (Ad(M)^-1 - I) x), where S is
            # the product of all factors after this joint.
            target_from_axis = host_adjoints(np.linalg.inv(later[k]) @ frame)
            by_frame = host_adjoints(np.linalg.inv(motion)) - identity
            by_ratio = joints[:, k, None] * AXIS_TWISTS[int(prismatic[k])]
            columns.append(target_from_axis @ by_frame[..., _AXIS_PARAMETERS])
            columns.append(target_from_axis @ by_ratio[..., None])
        columns.append(np.broadcast_to(identity, (len(joints), 6, 6)))
        return np.concatenate(columns, axis=-1)

    def _motions(
        self, joints: Float[np.ndarray, "views joints"], prismatic: tuple[bool, ...]
    ) -> Float[np.ndarray, "joints views 4 4"]:
        """Return the motion of each joint in the frame on its axis."""
        displacements = (self.ratios * joints).T
        twists = AXIS_TWISTS[np.array(prismatic, dtype=int)]
        return host_exponentials(displacements[..., None] * twists[:, None])

    def _targets_from_the_end(
        self, joints: Float[np.ndarray, "views joints"], prismatic: tuple[bool, ...]
    ) -> list[Float[np.ndarray, "views 4 4"]]:
        """Return the pose of the target where joints 1, 2, ... and all others before rest at zero.

        The first is the pose where all joints move, the last is `home`.
        """
        poses = [np.broadcast_to(self.home, (len(joints), 4, 4))]
        motions = self._motions(joints, prismatic)
        for frame, motion in zip(self.frames[::-1], motions[::-1], strict=True):
            poses.append(frame @ motion @ np.linalg.inv(frame) @ poses[-1])
        return poses[::-1]
