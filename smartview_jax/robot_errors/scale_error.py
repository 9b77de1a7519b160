"""Model the simplest smooth errors: a wrong scale of the robot's motion or of the target.

If all displacements of a robot are too long by one factor, its error is proportional to the
position of the *tool*. A target that is smaller than stated has the same effect, but in proportion
to the position of the *camera*. The two differ only by the rotation of the offset between tool and
camera, a very small effect; only a ruler separates them.
"""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..robots import Command
from ..runtime.compilation import one_program
from .field import AbstractField, AbstractLinearField
from .linear_fields import LinearInPose, centre_and_reach

ROBOT_SCALE_GROUP = "translation_by_stretch"
"""The name of the group with the single coefficient of the scale of the robot's displacements.

Files contain it, which is why it keeps the older word.
"""


class ScaleError(AbstractField):
    """A robot error field combined with a wrong scale of all displacements that the robot reports.

    A coefficient `s` of the scale is a relative error of `s / reach`. Linear fields can model a
    scale error too, but only together with shears of the same size: for them a robot whose scale is
    10 % too large may also be skewed by 10 %.

    Attributes:
        field: the other error, with which the scale error is combined.
        centre: position of the tool that the scale error does not displace, m.
        reach: distance from the centre that counts as one unit, m.
    """

    field: AbstractField
    centre: Float[Array, "3"]
    reach: Float[Array, ""]

    @classmethod
    def from_poses(cls, field: AbstractField, base_from_tool: SE3) -> "ScaleError":
        """Return the field centred on poses `(views)` and scaled by their standard deviation."""
        return cls(field, *centre_and_reach(base_from_tool))

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return (*self.field.groups, (ROBOT_SCALE_GROUP, 1))

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.field.names, f"{ROBOT_SCALE_GROUP}.0")

    @property
    def reference_length(self) -> float:
        return float(self.reach)

    def normalised_distance(self, reported: Command) -> Float[Array, "*views"]:
        return self.field.normalised_distance(reported)

    def actual_pose(self, reported: Command, coefficients: Float[Array, "coefficients"]) -> SE3:
        actual = self.field.actual_pose(reported, coefficients[:-1])
        return actual @ SE3.exp(-coefficients[-1] * self._scale_twist(reported))

    def jacobian(
        self, reported: Command, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "views 6 coefficients"]:
        # With a = scale_twist and its coefficient s, actual_pose = field(c) exp(-s a), and
        #     field(c) exp(d) exp(-s a) = actual_pose exp(Ad(exp(s a)) d):
        # the other field's Jacobian is transformed to the tool by the adjoint. The column of the
        # scale is -a.
        field_jacobian = self.field.jacobian(reported, coefficients[:-1])
        scale_twist = self._scale_twist(reported)
        adjoint = SE3.exp(coefficients[-1] * scale_twist).adjoint()
        return jnp.concatenate([adjoint @ field_jacobian, -scale_twist[..., None]], axis=-1)

    def _scale_twist(self, reported: Command) -> Float[Array, "*views 6"]:
        """Return the displacement from the centre as a twist at the tool, in units of the reach."""
        return _translation_twist(_displacement(reported.base_from_tool, self.centre) / self.reach)


class LinearInPoseWithScales(AbstractLinearField):
    """A robot error field: `LinearInPose` with scale errors of robot and target, 56 coefficients.

    A coefficient `s` of either scale is a relative error `s / reach`, by which the displacements
    that the robot reports are longer than the actual ones. The active groups are data: another
    selection needs no new compilation.

    Attributes:
        linear_in_pose: the linear field; its centre and reach also apply to the scale errors.
        scaled_point: point in the tool frame whose positions a wrong scale of the target scales, m:
            the centre of a camera on the tool, or the origin of a target on the tool.
        active_groups: one for each active group and zero for the others, in the order of `groups`.
    """

    ROBOT_SCALE: ClassVar[str] = ROBOT_SCALE_GROUP
    TARGET_SCALE: ClassVar[str] = "translation_by_scale"

    linear_in_pose: LinearInPose
    scaled_point: Float[Array, "3"]
    active_groups: Float[Array, "groups"]

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return (*self.linear_in_pose.groups, (self.ROBOT_SCALE, 1), (self.TARGET_SCALE, 1))

    @property
    def reference_length(self) -> float:
        return self.linear_in_pose.reference_length

    def normalised_distance(self, reported: Command) -> Float[Array, "*views"]:
        return self.linear_in_pose.normalised_distance(reported)

    def basis(self, base_from_tool: SE3) -> Float[Array, "*views 6 56"]:
        return self._with_scales(self.linear_in_pose.basis(base_from_tool), base_from_tool)

    @one_program
    def _with_scales(
        self, linear_basis: Float[Array, "*views 6 54"], base_from_tool: SE3
    ) -> Float[Array, "*views 6 56"]:
        """Return the active columns of the linear field and of the scale errors."""
        # Both scale errors are translations proportional to a position relative to the centre: the
        # position of the tool, and of the camera, which is offset from it by `scaled_point`.
        tool = _displacement(base_from_tool, self.linear_in_pose.centre) / self.linear_in_pose.reach
        camera = tool + _broadcast_like(self.scaled_point, tool) / self.linear_in_pose.reach
        scale_columns = jnp.stack([_translation_twist(tool), _translation_twist(camera)], axis=-1)
        group_sizes = np.array([size for _, size in self.groups])
        active_columns = jnp.repeat(self.active_groups, group_sizes, total_repeat_length=self.size)
        basis = jnp.concatenate([linear_basis, scale_columns], axis=-1)
        # A zero column removes a group without changing the shape of the problem.
        return basis * _broadcast_like(active_columns, basis)


def _displacement(base_from_tool: SE3, centre: Float[Array, "3"]) -> Float[Array, "*views 3"]:
    """Return the displacement from the centre to the tool, in the tool frame, m."""
    position = base_from_tool.translation()
    return base_from_tool.rotation().inverse() @ (position - _broadcast_like(centre, position))


def _translation_twist(translation: Float[Array, "*views 3"]) -> Float[Array, "*views 6"]:
    """Return the twist of a pure translation."""
    return jnp.concatenate([translation, jnp.zeros_like(translation)], axis=-1)


def _broadcast_like(
    vector: Float[Array, "n"], batch: Float[Array, "*batch n"]
) -> Float[Array, "*batch n"]:
    """Return a vector broadcast to the shape of a batch."""
    return jnp.broadcast_to(vector, batch.shape)
