"""The paper's comparison: extrinsics of a new viewpoint by linear interpolation.

    e(command) = sum_k w_k e^k

over the calibrated viewpoints, `w` being the least-norm weights of sum 1 that reproduce the
commanded position. `e` is yaw, pitch, roll and the translation of `camera_from_world`: averaging
angles is what this method does, and a reason why it is the worst of Table 1.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxlie import SE3, SO3
from jaxtyping import Array, Bool, Float

from ..cameras import Camera
from ..geometry import transform_points
from ..robots import CommandLike, as_command


class Interpolation(eqx.Module):
    """Calibrated viewpoints, and what lies between them.

    Attributes:
        camera: intrinsics common to all viewpoints (Step 2).
        positions: where the tool was at each, in the base frame, m.
        extrinsics: yaw, pitch, roll (rad, unwrapped) and translation (m) of each.
    """

    camera: Camera
    positions: Float[Array, "views 3"]
    extrinsics: Float[Array, "views 6"]

    def __init__(self, camera: Camera, base_from_tool: SE3, camera_from_world: SE3):
        angles = jnp.stack(camera_from_world.rotation().as_rpy_radians()[::-1], axis=-1)
        turns = jnp.round((angles - angles[:1]) / (2.0 * jnp.pi))
        self.camera = camera
        self.positions = base_from_tool.translation()
        self.extrinsics = jnp.concatenate(
            [angles - 2.0 * jnp.pi * turns, camera_from_world.translation()], axis=1
        )

    def weights(self, position: Float[Array, "*batch 3"]) -> Float[Array, "*batch views"]:
        """Least-norm weights with sum 1 that reproduce a position."""
        A = jnp.concatenate([jnp.ones((1, len(self.positions))), self.positions.T])
        b = jnp.concatenate([jnp.ones_like(position[..., :1]), position], axis=-1)
        return b @ jnp.linalg.pinv(A).T

    def camera_from_world(self, base_from_tool: CommandLike) -> SE3:
        """Extrinsics at the given robot poses, `(*views)`."""
        e = self.weights(as_command(base_from_tool).base_from_tool.translation()) @ self.extrinsics
        rotation = SO3.from_rpy_radians(e[..., 2], e[..., 1], e[..., 0])
        return SE3.from_rotation_and_translation(rotation, e[..., 3:])

    def points_in_camera(
        self, base_from_tool: CommandLike, points: Float[Array, "*points 3"]
    ) -> Float[Array, "*moved 3"]:
        """Target points in the camera frame, m."""
        return transform_points(self.camera_from_world(base_from_tool), jnp.asarray(points, float))

    def project(
        self, base_from_tool: CommandLike, points: Float[Array, "*points 3"]
    ) -> tuple[Float[Array, "*pixels 2"], Bool[Array, "*pixels"]]:
        """Pixels of target points, shapes as in `Calibration.project`."""
        return self.camera.project(self.points_in_camera(base_from_tool, points))
