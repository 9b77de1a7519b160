"""Hold the poses that a tracker measured in place of pixels, and compute their residuals."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..calibration import TargetShape
from ..robots import Command
from ..runtime.modules import with_fields
from ..runtime.padding import padded_counts, repeat_last

PAIRS = 3
"""Number of pairs into which the six numbers of a pose are divided, as if each were a pixel."""


class PoseObservations(eqx.Module):
    """The poses of the target in the camera's frame that a tracker measured, one in each view.

    It takes the place of `Observations`, where each visible point has two numbers: the six numbers
    of a pose are three pairs.

    Attributes:
        camera_from_world: measured poses, one transform per view.
        whitening: matrix of each view that brings the error of a measured pose, translation (m)
            and rotation vector (rad) in the camera's axes, to unit covariance for a tracker with
            noise of one unit.
        visible: mask of the measured pairs; the three of a view are equal.
        base_from_tool: poses reported by the robot, one transform per view.
        joints: readings of the robot's joints, rad or m; None if unknown.
    """

    camera_from_world: SE3
    whitening: Float[Array, "*views 6 6"]
    visible: Bool[Array, "*views 3"]
    base_from_tool: SE3
    joints: Float[Array, "*views joints"] | None = None

    @property
    def command(self) -> Command:
        """The commands reported by the robot, with joint readings if they are known."""
        return Command(self.base_from_tool, self.joints)

    @property
    def pixels(self) -> Float[Array, "*views 3 2"]:
        """Zeros in the place of pixels: `residuals` compares the poses themselves."""
        return jnp.zeros((*self.visible.shape, 2))

    def of_shape(self, shape: TargetShape | None) -> "PoseObservations":
        """Return the observations themselves: a tracked pose does not depend on single points."""
        return self

    def padded(self) -> "PoseObservations":
        """Return the observations with views added in which nothing was measured (`padding`)."""
        count, views = padded_counts(len(self.visible))[0], len(self.visible)
        if count == views:
            return self
        visible = np.zeros((count, PAIRS), dtype=bool)
        visible[:views] = np.asarray(self.visible)
        host = jax.tree.map(
            np.asarray, (self.camera_from_world, self.whitening, self.base_from_tool, self.joints)
        )
        measured, whitening, base_from_tool, joints = repeat_last(host, count)
        return with_fields(
            self,
            camera_from_world=measured,
            whitening=whitening,
            visible=visible,
            base_from_tool=base_from_tool,
            joints=joints,
        )

    def differences(
        self, camera_from_world: SE3, target_scale: Float[Array, ""]
    ) -> Float[Array, "*views 6"]:
        """Return measured minus predicted translations (m), and the rotations between them (rad).

        A tracker that knows a wrong size of the target, or none, measures `translation / scale`.

        Args:
            camera_from_world: predicted poses.
            target_scale: ratio of the target's true size to the size that the tracker assumes.
        """
        measured = self.camera_from_world
        translation = measured.translation() - camera_from_world.translation() / target_scale
        rotation = (measured.rotation() @ camera_from_world.rotation().inverse()).log()
        return jnp.concatenate([translation, rotation], axis=-1)

    def residuals(
        self, camera_from_world: SE3, target_scale: Float[Array, ""]
    ) -> Float[Array, "*views 3 2"]:
        """Return `differences` in standard deviations of a tracker with noise of one unit."""
        numbers = self.differences(camera_from_world, target_scale)
        numbers = (self.whitening @ numbers[..., None])[..., 0]
        pairs = numbers.reshape(*numbers.shape[:-1], PAIRS, 2)
        return jnp.where(self.visible[..., None], pairs, 0.0)
