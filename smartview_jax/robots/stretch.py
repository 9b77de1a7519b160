"""A smooth error and its two simplest forms: the robot goes too far, or the target is not its size.

A robot whose ways are all too long by one share errs in proportion to where its *tool* is. A target
that is smaller than it is said to be looks the same, but for where the *camera* is. The two differ
by how the offset between tool and camera turns, which is next to nothing; only a ruler tells them
apart.
"""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from .command import Command
from .field import AbstractLinearField
from .linear_fields import LinearInPose


class PoseOrStretch(AbstractLinearField):
    """`LinearInPose`, a stretch of the tool's ways, and one of the camera's: 56 coefficients.

    A coefficient `c` of either stretch is a share `c / reach` by which the ways that the robot
    reports are longer than those it goes. Which groups count is data: another choice is not another
    program.

    Attributes:
        pose: the field besides; its centre and reach are the stretches' too.
        seen_from: the tool's frame: what a wrong scale of the target keeps in proportion, m: the
            centre of a camera on the tool; of a target on the tool, its origin.
        counts: one for each group that counts, zero for the others, in the order of `groups`.
    """

    STRETCH: ClassVar[str] = "translation_by_stretch"
    SCALE: ClassVar[str] = "translation_by_scale"

    pose: LinearInPose
    seen_from: Float[Array, "3"]
    counts: Float[Array, "groups"]

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return (*self.pose.groups, (self.STRETCH, 1), (self.SCALE, 1))

    def extent(self, reported: Command) -> Float[Array, "*views"]:
        return self.pose.extent(reported)

    def basis(self, base_from_tool: SE3) -> Float[Array, "*views 6 56"]:
        position = base_from_tool.translation()
        way = base_from_tool.rotation().inverse() @ (position - _like(self.pose.centre, position))
        tool = way / self.pose.reach
        camera = tool + _like(self.seen_from, tool) / self.pose.reach
        shifts = jnp.stack([tool, camera], axis=-1)
        stretches = jnp.concatenate([shifts, jnp.zeros_like(shifts)], axis=-2)
        sizes = np.array([size for _, size in self.groups])
        counts = jnp.repeat(self.counts, sizes, total_repeat_length=self.size)
        basis = jnp.concatenate([self.pose.basis(base_from_tool), stretches], axis=-1)
        return basis * _like(counts, basis)


def _like(vector: Float[Array, "n"], many: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
    return jnp.broadcast_to(vector, many.shape)
