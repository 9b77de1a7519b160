"""Describe how uncertain the camera and the poses of views are, for all features they see.

Errors of the calibration are common to everything seen in the views. They are described by one
vector of numbers: the parameters that a fit estimated, with their covariance, and the robot's noise
in each view, six numbers at the tool. An estimated feature has a Jacobian by this vector instead of
a separate covariance, so that common errors cancel in distances.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypedDict

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..calibration import Calibration
from ..cameras import distinct_cameras, moved_cameras
from ..engine import (
    Noise,
    Parameters,
    PreparedPoses,
    Step,
    correction_names,
    linearise_poses,
    parameter_names,
)
from ..evaluation import CalibrationEstimate, covariance_root
from ..geometry import host_exponentials, host_matrices
from ..robots import Command, CommandLike
from ..runtime.compilation import compiled
from ..runtime.padding import repeat_last
from .rig_views import AnyCalibration, RigViews
from .view_poses import SeenViews, as_rigid_command, chain_command, padded_views


class UncertaintyOptions(TypedDict, total=False):
    """The uncertainty of a calibration and of its views, as keyword arguments.

    Attributes:
        covariance: a joint fit, or a bound, with the uncertainty of the calibration; None takes the
            calibration as exact.
        noise: sizes of the robot's noise in these views; by default the noise of the fit.
    """

    covariance: CalibrationEstimate | None
    noise: Noise | None


class CalibrationUncertainty(NamedTuple):
    """The uncertain numbers of a calibration and of some views, with their covariance.

    Attributes:
        names: names of the numbers, as in `JointFit.std`; the views' own noise comes last.
        covariance: covariance of the numbers, in their own units.
        view_jacobian: derivatives, by the numbers, of the parameters of the camera, or of all
            cameras, and of the twist of `camera_from_world` in the camera frame (translation,
            rotation), in each view.
        shared_count: the first so many numbers are common to all views; six for each view follow,
            or for each state of the robot in which several cameras took views.
    """

    names: tuple[str, ...]
    covariance: Float[np.ndarray, "numbers numbers"]
    view_jacobian: Float[np.ndarray, "views local numbers"]
    shared_count: int

    @property
    def shared_names(self) -> tuple[str, ...]:
        """The names of the numbers that are common to all views."""
        return self.names[: self.shared_count]

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
        calibration: AnyCalibration,
        covariance: CalibrationEstimate | None = None,
        noise: Noise | None = None,
    ) -> "CalibrationUncertainty":
        """Return the description for views that were not used to estimate the calibration.

        Args:
            calibration: their calibration, or their cameras.
            covariance: a joint fit or a bound with the calibration's covariance; None for an exact
                calibration, and for cameras, which have their own.
            noise: sizes of the robot's noise; by default the noise of a joint fit.

        Raises:
            ValueError: the estimate is of other parameters, leaves something undetermined, or its
                noise leaves the poses free.
        """
        if isinstance(calibration, RigViews):
            if covariance is not None:
                raise ValueError(
                    "covariance: expected None, since views of a rig have the rig's own; make "
                    "RigViews from the fit"
                )
            return cls._of_rig(views, calibration, noise)
        if covariance is None and noise is None:
            return cls.none(views)
        count = len(views.camera_from_world)
        return cls._of_commands(views.command, count, calibration, covariance, noise)

    @classmethod
    def at(
        cls,
        calibration: Calibration,
        poses: CommandLike,
        covariance: CalibrationEstimate,
        noise: Noise | None = None,
    ) -> "CalibrationUncertainty":
        """Return the description for reported poses, for which no extrinsics are computed.

        Args:
            calibration: the calibration of one camera.
            poses: reported poses, `(views)`.
            covariance, noise: as in `of`.

        Raises:
            ValueError: as in `of`, or a pose that is not rigid.
        """
        calibration.require_one_arm("the uncertainty of a camera's pose")
        reported = as_rigid_command(poses)
        count = len(reported.base_from_tool.wxyz_xyz)
        return cls._of_commands(padded_views(reported), count, calibration, covariance, noise)

    @classmethod
    def _of_commands(
        cls,
        padded: Command,
        count: int,
        calibration: Calibration,
        covariance: CalibrationEstimate | None,
        noise: Noise | None,
    ) -> "CalibrationUncertainty":
        """Return the description for the first `count` of padded reported poses."""
        # A bound has no noise: either it is given, or the poses are exact.
        if noise is None:
            noise = getattr(covariance, "noise", None)
        names = parameter_names(calibration)
        roots = np.zeros((0, len(names)))
        if covariance is not None:
            if parameter_names(covariance.calibration) != names:
                raise ValueError(
                    "covariance: its parameters are "
                    f"{', '.join(parameter_names(covariance.calibration))}; the calibration has "
                    f"{', '.join(names)}"
                )
            roots = np.asarray(covariance_root(covariance))
        # Fixed parameters are exact and have no column, usually the target's scale and fixed
        # intrinsics.
        used = np.flatnonzero(np.any(roots != 0.0, axis=0))
        shared, per_view = map(np.asarray, _view_jacobians(calibration, padded))
        known = cls(
            tuple(names[k] for k in used),
            roots[:, used].T @ roots[:, used],
            shared[:count, :, used],
            len(used),
        )
        if noise is None:
            return known
        # Six numbers for each view, named as the corrections of a fit's own views.
        views_named = [str(k) for k in range(count)]
        poses = host_matrices(padded.base_from_tool)[:count]
        covariances = _noise_covariances(noise, poses)
        return known._with_twists(covariances, views_named, np.arange(count), per_view)

    @classmethod
    def _of_rig(
        cls, views: SeenViews, rig_views: RigViews, noise: Noise | None
    ) -> "CalibrationUncertainty":
        """Return the description for views of several cameras."""
        estimate = rig_views.estimate
        if estimate is None and noise is None:
            return cls.none(views)
        names, known = (), np.zeros((0, 0))
        if estimate is not None:
            names, known = estimate.parameter_names, estimate.covariance
            noise = estimate.noise if noise is None else noise
        assert noise is not None
        chains = list(rig_views.chains())
        needed = {name for chain in chains for name in chain.numbers}
        used = [k for k, name in enumerate(names) if name in needed and known[k, k] > 0.0]
        column = {names[k]: n for n, k in enumerate(used)}
        count = len(views.camera_from_world)
        jacobian = np.zeros((count, camera_parameter_count(views) + 6, len(used)))
        # A fixed camera does not feel the robot's noise.
        per_view, first = np.zeros((count, 6, 6)), 0
        for chain in chains:
            command = chain_command(chain, views.command)
            shared, by_noise = map(np.asarray, _view_jacobians(chain.calibration, command))
            cameras = shared.shape[1] - 6
            for k, name in enumerate(chain.numbers):
                # Every view lists the parameters of all cameras, whichever took it.
                if name in column and k < cameras:
                    jacobian[:, first + k, column[name]] = 1.0
                elif name in column:
                    jacobian[chain.views, -6:, column[name]] = shared[: len(chain.views), -6:, k]
            if not chain.is_fixed:
                per_view[chain.views] = by_noise[: len(chain.views)]
            first += cameras
        # Pictures of several cameras in one state share the robot's noise.
        poses = host_matrices(views.command.base_from_tool)[:count]
        states = rig_views.state_indices(poses)
        state_names = [str(k) for k in range(int(states.max()) + 1)]
        covariances = _noise_covariances(noise, poses[np.unique(states, return_index=True)[1]])
        shared_part = cls(
            tuple(names[k] for k in used), known[np.ix_(used, used)], jacobian, len(used)
        )
        return shared_part._with_twists(covariances, state_names, states, per_view)

    def resized(self, views: SeenViews, target: SeenViews) -> "CalibrationUncertainty":
        """Return the uncertainty of the cameras of the same pictures brought to another size.

        Args:
            views: with the cameras of the pictures as they are.
            target: with the cameras of the resized pictures; see `Camera.resized`.
        """
        # Focal lengths and principal point come first, and are in px; a lens has no px.
        factors = np.ones(self.view_jacobian.shape[1])
        first = 0
        cameras = distinct_cameras(views.camera), distinct_cameras(target.camera)
        for old, new in zip(*cameras, strict=True):
            by_u, by_v = (b / a for a, b in zip(old.image_size, new.image_size, strict=True))
            factors[first : first + 4] = by_u, by_v, by_u, by_v
            first += sum(np.size(leaf) for leaf in jax.tree.leaves(old))
        return self._replace(view_jacobian=factors[:, None] * self.view_jacobian)

    def corrected(self, views: SeenViews, error: Float[np.ndarray, "numbers"]) -> SeenViews:
        """Return views whose cameras and poses are corrected by errors of the numbers.

        An error of the calibration displaces each picture as a whole, differently from the others,
        so that no pose of an object fits its edges in all pictures. This is no evidence against the
        object.

        Args:
            views: cameras and poses as calibrated.
            error: true minus calibrated numbers.
        """
        if not len(error):
            return views
        local = self.view_jacobian @ error
        # Every view lists the parameters of all cameras, before its own twist.
        camera = moved_cameras(views.camera, local[0, :-6])
        moved = host_exponentials(local[:, -6:]) @ views.camera_from_world
        padded = repeat_last(moved, len(views.padded))
        return views._replace(camera=camera, camera_from_world=moved, padded=padded)

    def with_view_errors(self, translation: float, rotation: float) -> "CalibrationUncertainty":
        """Return the uncertainty with a further error of each camera pose, six numbers a view.

        Args:
            translation: standard deviation of the twist of `camera_from_world`, per axis, m.
            rotation: the same of its rotation, rad.
        """
        count = len(self.view_jacobian)
        return self._with_twists(
            np.tile(np.diag(np.repeat([translation**2, rotation**2], 3)), (count, 1, 1)),
            [f"camera of view {k}" for k in range(count)],
            np.arange(count),
            np.tile(np.eye(6), (count, 1, 1)),
        )

    def _with_twists(
        self,
        covariances: Float[np.ndarray, "twists 6 6"],
        names: Sequence[str],
        twist_of_view: Int[np.ndarray, "views"],
        by_twist: Float[np.ndarray, "views 6 6"],
    ) -> "CalibrationUncertainty":
        """Return the uncertainty with further independent twists, each of one or more views.

        Args:
            covariances: covariance of each twist, m and rad.
            names: of the twists.
            twist_of_view: index of the twist that moves each view.
            by_twist: derivatives of each view's twist by it.
        """
        columns = np.zeros((*self.view_jacobian.shape[:2], 6 * len(names)))
        for view, (twist, derivatives) in enumerate(zip(twist_of_view, by_twist, strict=False)):
            columns[view, -6:, 6 * twist : 6 * twist + 6] = derivatives
        # Not by SciPy, which the robot's commands do not import.
        known = len(self.covariance)
        covariance = np.zeros((known + columns.shape[-1],) * 2)
        covariance[:known, :known] = self.covariance
        for k, of_twist in enumerate(covariances):
            place = slice(known + 6 * k, known + 6 * (k + 1))
            covariance[place, place] = of_twist
        return CalibrationUncertainty(
            (*self.names, *correction_names(names)),
            covariance,
            np.concatenate([self.view_jacobian, columns], axis=2),
            self.shared_count,
        )

    def propagate(
        self, view_sensitivity: Float[np.ndarray, "views *rest local"]
    ) -> Float[np.ndarray, "*rest numbers"]:
        """Return derivatives by the numbers from derivatives by each view's camera and twist."""
        return np.einsum("v...l,vln->...n", view_sensitivity, self.view_jacobian)


def camera_parameter_count(views: SeenViews) -> int:
    """Return the number of intrinsic parameters of all cameras, lenses included."""
    return sum(np.size(leaf) for leaf in jax.tree.leaves(distinct_cameras(views.camera)))


def _noise_covariances(
    noise: Noise, base_from_tool: Float[np.ndarray, "poses 4 4"]
) -> Float[np.ndarray, "poses 6 6"]:
    """Return the covariance of the twist of each reported pose."""
    if not np.isfinite([noise.translation, noise.rotation]).all():
        raise ValueError("covariance: infinite robot noise, so the views' poses are unknown")
    return noise.pose_covariances(base_from_tool[:, :3, :3].swapaxes(1, 2))


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
    poses = linearise_poses(parameters, step, command, prepared)
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
