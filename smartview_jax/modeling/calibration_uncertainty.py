"""Describe how uncertain the camera and the poses of views are, for all features they see.

Errors of the calibration are common to everything seen in the views. They are described by one
vector of numbers: the parameters that a fit estimated, with their covariance, and the robot's noise
in each view, six numbers at the tool. An estimated feature has a Jacobian by this vector instead of
a separate covariance, so that common errors cancel in distances.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..calibration import Calibration
from ..cameras import Camera
from ..engine import Noise, Parameters, PreparedPoses, Step, linearise_poses, parameter_names
from ..evaluation import CalibrationEstimate, covariance_root
from ..joint import JointFit, SavedEstimate
from ..robots import Command
from ..runtime.compilation import compiled
from .view_poses import SeenViews


class CalibrationUncertainty(NamedTuple):
    """The uncertain numbers of a calibration and of some views, with their covariance.

    Attributes:
        names: names of the numbers, as in `JointFit.std`; the views' own noise comes last.
        covariance: covariance of the numbers, in their own units.
        view_jacobian: derivatives, by the numbers, of the camera's parameters and of the twist of
            `camera_from_world` in the camera frame (translation, rotation), in each view.
        shared_count: the first so many numbers are common to all views; six for each view follow.
    """

    names: tuple[str, ...]
    covariance: Float[np.ndarray, "numbers numbers"]
    view_jacobian: Float[np.ndarray, "views local numbers"]
    shared_count: int

    @classmethod
    def none(cls, views: SeenViews) -> "CalibrationUncertainty":
        """Return the description of a calibration that is taken as exact."""
        local = camera_parameter_count(views) + 6
        empty = np.zeros((len(views.camera_from_world), local, 0))
        return cls((), np.zeros((0, 0)), empty, 0)

    @classmethod
    def of(
        cls,
        views: SeenViews,
        calibration: Calibration,
        estimate: CalibrationEstimate | None,
        noise: Noise | None = None,
    ) -> "CalibrationUncertainty":
        """Return the description for views that were not used to estimate the calibration.

        Args:
            views: the views.
            calibration: their calibration.
            estimate: a joint fit or a bound with the calibration's covariance; None for an exact
                calibration.
            noise: sizes of the robot's noise; by default the noise of a joint fit.

        Raises:
            ValueError: the estimate is of other parameters, leaves something undetermined, or its
                noise leaves the poses free.
        """
        if estimate is None and noise is None:
            return cls.none(views)
        # A bound has no noise: either it is given, or the poses are exact.
        if noise is None and isinstance(estimate, (JointFit, SavedEstimate)):
            noise = estimate.noise
        names = parameter_names(calibration)
        roots = np.zeros((0, len(names)))
        if estimate is not None:
            if parameter_names(estimate.calibration) != names:
                raise ValueError(
                    "covariance: its parameters are "
                    f"{', '.join(parameter_names(estimate.calibration))}; the calibration has "
                    f"{', '.join(names)}"
                )
            roots = np.asarray(covariance_root(estimate))
        # Fixed parameters are exact and have no column, usually the target's scale and fixed
        # intrinsics.
        used = np.flatnonzero(np.any(roots != 0.0, axis=0))
        shared, per_view = map(np.asarray, _view_jacobians(calibration, views.command))
        count = len(views.camera_from_world)
        sigmas = np.zeros(0)
        if noise is not None:
            sigmas = np.repeat([noise.translation, noise.rotation], 3)
            if not np.isfinite(sigmas).all():
                raise ValueError(
                    "covariance: infinite robot noise, so the views' poses are unknown"
                )
        # Six numbers for each view, independent of all others.
        size = len(sigmas) * count
        jacobian = np.zeros((count, shared.shape[1], len(used) + size))
        jacobian[:, :, : len(used)] = shared[:count, :, used]
        covariance = np.zeros((jacobian.shape[2],) * 2)
        covariance[: len(used), : len(used)] = roots[:, used].T @ roots[:, used]
        if size:
            for k in range(count):
                place = slice(len(used) + 6 * k, len(used) + 6 * k + 6)
                jacobian[k, -6:, place] = per_view[k]
                covariance[place, place] = np.diag(sigmas**2)
        # Named as the corrections of a fit's own views, here for these views.
        noise_names = parameter_names(calibration, [str(k) for k in range(count if size else 0)])
        own_names = noise_names[len(names) :]
        return cls((*(names[k] for k in used), *own_names), covariance, jacobian, len(used))

    def resized(self, camera: Camera, target: Camera) -> "CalibrationUncertainty":
        """Return the uncertainty of the camera of the same pictures brought to another size.

        Args:
            camera: of the pictures as they are.
            target: of the resized pictures; see `Camera.resized`.
        """
        by_u, by_v = (
            new / old for new, old in zip(target.image_size, camera.image_size, strict=True)
        )
        # Focal lengths and principal point come first, and are in px; a lens has no px.
        factors = np.ones(self.view_jacobian.shape[1])
        factors[:4] = by_u, by_v, by_u, by_v
        return self._replace(view_jacobian=factors[:, None] * self.view_jacobian)

    def propagate(
        self, view_sensitivity: Float[np.ndarray, "views *rest local"]
    ) -> Float[np.ndarray, "*rest numbers"]:
        """Return derivatives by the numbers from derivatives by each view's camera and twist."""
        return np.einsum("v...l,vln->...n", view_sensitivity, self.view_jacobian)


def camera_parameter_count(views: SeenViews) -> int:
    """Return the number of intrinsic parameters, lens included."""
    return sum(np.size(leaf) for leaf in jax.tree.leaves(views.camera))


@compiled
def _view_jacobians(
    calibration: Calibration, command: Command
) -> tuple[Float[Array, "views local shared"], Float[Array, "views 6 6"]]:
    """Return derivatives of camera and twist by the shared parameters and by the view's correction.

    It is the twist of `camera_from_world`, in the camera frame.
    """
    error = calibration.robot_error
    prepared = None if error is None else PreparedPoses.at(error.field, command)
    parameters = Parameters(calibration)
    layout, count = parameters.layout, len(command.base_from_tool.wxyz_xyz)
    step = Step(jnp.zeros(layout.size), jnp.zeros((count, 6)))
    # The chain of Eq. 10 and its derivatives come from the joint fit.
    poses = linearise_poses(parameters, step, command.base_from_tool, prepared)
    # The target's scale does not affect other objects, which are measured in metres. The order is
    # the one of `Parameters`: camera, both transforms, scale, field.
    chained = layout.size - layout.camera.stop
    scale = layout.target_scale.start - layout.camera.stop
    twist = poses.shared_jacobian.at[:, :, scale].set(0.0)
    camera_size = layout.camera.stop
    camera = jnp.broadcast_to(jnp.eye(camera_size), (count, camera_size, camera_size))
    shared = jnp.concatenate(
        [
            jnp.concatenate([camera, jnp.zeros((count, camera_size, chained))], axis=2),
            jnp.concatenate([jnp.zeros((count, 6, camera_size)), twist], axis=2),
        ],
        axis=1,
    )
    return shared, poses.per_view_jacobian
