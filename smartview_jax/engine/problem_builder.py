"""Build the least-squares problem of a joint fit from the user's arguments.

It combines the lens, the noise model, the free and fixed parameters, and the priors.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Unpack

import equinox as eqx
import jax
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from ..calibration import Calibration, DepthBias, host_mount_from_holder
from ..cameras import AbstractLens, Camera, initial_lens
from ..dataset import (
    TYPICAL_OFFSET_STD,
    TYPICAL_SCALE_STD,
    Dataset,
    chain_residuals,
    require_same_set_up,
)
from ..geometry import host_transforms
from ..robot_errors import AbstractField, FieldChoice, RobotError, checked_field_choice
from ..runtime.array_namespace import to_device, to_device_together
from ..runtime.compilation import compiled, refuse_traced
from ..runtime.modules import with_fields
from .abstract_problem import AbstractBuiltProblem
from .losses import AbstractLoss, loss_by_name
from .noise import Noise
from .parameters import (
    DEPTH_BIAS_NAMES,
    ROBOT_ERROR,
    TARGET_SCALE,
    Parameters,
    Step,
    is_size,
    parameter_mask,
    parameter_names,
)
from .prepared_poses import prepare_poses
from .priors import ParameterChoice, ParameterOptions, ParameterTable, Prior
from .problem import JointProblem

TYPICAL_DEPTH_BIAS = dict(
    zip(
        DEPTH_BIAS_NAMES,
        (Prior(mean=1.0, std=TYPICAL_SCALE_STD), Prior(mean=0.0, std=TYPICAL_OFFSET_STD)),
        strict=True,
    )
)
"""Priors of the bias of the depths that a camera measures."""


class BuiltProblem(AbstractBuiltProblem):
    """A least-squares problem together with the names of its parameters.

    Attributes:
        problem: the problem, in the parameters' own units.
        shared_names: names of the free shared parameters.
        per_view_names: names of the free parameters of single views, in order.
        noise: the assumed noise; None if the robot's poses are taken as exact.
        unprojectable: visible points that cannot be projected at the start; they are left out.
    """

    problem: JointProblem
    shared_names: tuple[str, ...] = eqx.field(static=True)
    per_view_names: tuple[str, ...] = eqx.field(static=True)
    noise: Noise | None = eqx.field(static=True)
    unprojectable: Bool[np.ndarray, "views points"]

    def pose_parameters(self, usable_views: Int[np.ndarray, "usable"]) -> int:
        """Return the number of free parameters of the poses of these views."""
        return int(np.asarray(self.problem.per_view_free)[usable_views].sum())

    def with_noise_corrections(self, corrections: Float[np.ndarray, "views 6"]) -> "BuiltProblem":
        """Return the problem with the robot error field at poses corrected for noise."""
        return with_fields(self, problem=self.problem.with_noise_corrections(corrections))

    def with_correction_roots(self, roots: Float[np.ndarray, "views 6 6"]) -> "BuiltProblem":
        """Return the problem with other axes of the views' own parameters."""
        return dataclasses.replace(self, problem=self.problem.with_correction_roots(roots))

    def with_prior_centre(self, centre: Calibration) -> "BuiltProblem":
        """Return the problem with the priors that have no mean centred there, not at the start."""
        problem = self.problem
        mean, weight = (np.array(s.shared) for s in (problem.prior_mean, problem.prior_weight))
        about_start = np.isnan(mean) & (weight > 0.0)
        if not about_start.any():
            return self
        has_bias = problem.parameters.start.depth_bias is not None
        if has_bias != (centre.depth_bias is not None):
            centre = dataclasses.replace(centre, depth_bias=DepthBias() if has_bias else None)
        mean[about_start] = np.asarray(_values_at(problem.parameters, centre))[about_start]
        centred = Step(to_device(mean), problem.prior_mean.per_view)
        return with_fields(self, problem=with_fields(problem, prior_mean=centred))

    @property
    def sigma_known(self) -> bool:
        """Whether the pixel sigma is taken as given; if not, it is estimated from the residuals."""
        return self.noise is not None and self.noise.has_pose_prior

    @property
    def depends_on_sigma(self) -> bool:
        """Whether the result depends on the pixel sigma, because of a prior or a robust loss."""
        weight = self.problem.prior_weight
        shared = np.asarray(weight.shared)[np.asarray(self.problem.free)]
        per_view = np.asarray(weight.per_view)[np.asarray(self.problem.per_view_free)]
        return self.problem.loss is not None or bool(shared.any() or per_view.any())


def build_problem(
    data: Dataset,
    start: Calibration,
    *,
    lens: str | AbstractLens | None = None,
    noise: str | Noise = "trusted",
    loss: str | AbstractLoss | None = None,
    field: FieldChoice = "auto",
    **parameters: Unpack[ParameterOptions],
) -> BuiltProblem:
    """Build the least-squares problem of `fit_joint`; arguments and errors are as there.

    Priors without a mean are centred at the start. The coefficients of a robot error field begin at
    their values in the start if it has the same field, otherwise at zero. With `field="auto"` the
    robot error of the start is held.

    For example:

        >>> built = sv.build_problem(data, truth)
        >>> print(len(built.shared_names), built.shared_names[:2])
        17 ('camera.alpha_u', 'camera.alpha_v')
    """
    refuse_traced("build_problem", data, start)
    noise_model = _checked_noise(noise)
    choice = ParameterChoice.of(**parameters)
    _require_same_setup(data, start)
    if start.base_from_other_base is not None:
        data = data.with_bases(start.base_from_other_base)
    field = checked_field_choice(field)
    start = with_depth_bias(with_field(with_lens(start, lens), field), data)
    views = data.usable_views()
    if len(views) < 3 and not choice.priors:
        raise ValueError(
            f"a joint fit needs at least 3 views with 4 points each, or priors; found {len(views)}"
        )
    if start.depth_bias is not None:
        choice = choice._replace(priors=TYPICAL_DEPTH_BIAS | choice.priors)
        data = data if noise_model is None else with_known_depth_noise(data, noise_model)
    shared_size = Parameters(start).layout.size
    names = parameter_names(start, data.view_ids if noise_model else ())
    holds_error = field == "auto" and start.robot_error is not None
    is_free = choice.is_free(names, [TARGET_SCALE, *([ROBOT_ERROR] if holds_error else [])])
    choice, aspects = choice.with_fitted_aspects(names, is_free)
    fitted_field = None if field == "auto" else field
    size = float(np.asarray(start.target_scale))
    mean, weight = prior_means_and_weights(
        names, shared_size, choice.priors, noise_model, fitted_field, size
    )
    if noise_model is not None:
        # The correction of a view with too few points to determine its pose is held, unless a prior
        # constrains it.
        usable = np.isin(np.arange(data.view_count), views).repeat(6)
        is_free[shared_size:] &= usable | (weight[shared_size:] > 0.0)
    table = ParameterTable(names, shared_size, is_free, mean, weight)
    # Arrays are created by NumPy, because every JAX operation on the host would be compiled.
    arrays = {
        "pixel_sigma": np.array(noise_model.pixel if noise_model else 1.0),
        **table.fields(),
    }
    unprojectable = unprojectable_points(data, start)
    visible = to_device(np.asarray(data.visible) & ~unprojectable)
    problem = JointProblem(
        parameters=Parameters(start, to_device(np.array(True)) if aspects else None),
        observations=with_fields(data.observations, visible=visible),
        **to_device_together(arrays),
        loss=loss_by_name(loss),
        prepared_poses=prepare_poses(start.robot_error, data.observations.command),
    )
    return BuiltProblem(
        problem, table.shared_names, table.per_view_names, noise_model, unprojectable
    )


def _checked_noise(noise: str | Noise) -> Noise | None:
    """Return the noise; None for exact poses of the robot.

    Raises:
        ValueError: another text than `"trusted"`.
    """
    if isinstance(noise, Noise):
        return noise
    if noise != "trusted":
        raise ValueError(
            'noise is "trusted", "estimated" or a Noise(pixel, translation, rotation), where '
            f'"estimated" is for fit_joint only; found {noise!r}'
        )
    return None


def _require_same_setup(data: Dataset, start: Calibration) -> None:
    """Raise a ValueError if a start is of another set-up or number of arms than the data."""
    require_same_set_up("the start", start, data)
    if (data.hands is None) != (start.base_from_other_base is None):
        raise ValueError(
            "base_from_other_base: a start has it for the data of two arms, and only for these"
        )


def with_free_camera_poses(
    data: Dataset,
    camera: Camera,
    camera_from_world: SE3,
    field: AbstractField | None = None,
    mount: str = "eye_in_hand",
) -> tuple[Dataset, Calibration]:
    """Return data and a start in which camera poses of the views replace the reported poses.

    With both transforms held, the corrections of the reported poses are then free camera poses: the
    corrected pose of a view is `exp(correction) @ camera_from_world` for a camera on the hand, and
    `camera_from_world @ exp(-correction)` for one next to the robot. The mount, and a robot error
    field (without joints), which gets zero coefficients, have no effect, but give the problem the
    structure of a fit with these.
    """
    identity = host_transforms(np.eye(4))
    error = None if field is None else RobotError.zero(field)
    identity_start = Calibration(camera, identity, identity, mount, robot_error=error)
    repositioned = with_fields(
        data,
        base_from_tool=host_mount_from_holder(mount, camera_from_world),
        mount=mount,
        hands=None,
    )
    return repositioned, identity_start


def without_region(start: Calibration) -> Calibration:
    """Return the start without the region of viewpoints, which describes an earlier fit's data.

    So starts from a fit and from elsewhere share the solver's program.
    """
    return start if start.region is None else with_fields(start, region=None)


def with_lens(start: Calibration, lens: str | AbstractLens | None) -> Calibration:
    """Return the start with another lens, initialised from the present one; None keeps it."""
    start = without_region(start)
    if lens is None:
        return start
    return eqx.tree_at(lambda c: c.camera.lens, start, initial_lens(lens, start.camera.lens))


def with_field(start: Calibration, field: FieldChoice) -> Calibration:
    """Return the start with a given robot error field; `"auto"` keeps the present one."""
    if field == "auto":
        return start
    if field is None:
        return start.uncorrected
    current = start.robot_error
    if current is not None and equal_on_host(current.field, field):
        return start
    return with_fields(start, robot_error=RobotError.zero(field))


def with_depth_bias(start: Calibration, data: Dataset) -> Calibration:
    """Return the start with a bias of depths where the data have depths, and without elsewhere."""
    if data.depths is None:
        return start if start.depth_bias is None else with_fields(start, depth_bias=None)
    if start.depth_bias is not None:
        return start
    return dataclasses.replace(start, depth_bias=DepthBias())


def with_known_depth_noise(data: Dataset, noise: Noise, factor: float = 1.0) -> Dataset:
    """Return the data whose depths count relative to a stated noise of pixels.

    Data without depths, and depths that count relative to a noise already, stay as they are.

    Args:
        data: the data set.
        noise: the noise; without standard deviations of the poses it states none.
        factor: of this camera's pixel noise.
    """
    if not noise.has_pose_prior:
        return data
    return with_weighed_depths(data, factor * noise.within_view_pixel)


def with_weighed_depths(data: Dataset, pixel_sigma: float) -> Dataset:
    """Return the data whose depths count relative to pixels of a standard deviation, px.

    Data without depths, and depths that count relative to a noise already, stay as they are.
    """
    depths, stated = data.depths, data.depth_noise
    if depths is None or depths.is_weighed:
        return data
    common = 0.0 if stated is None else stated.common or 0.0
    return dataclasses.replace(data, depths=depths.weighed(pixel_sigma, common))


def equal_on_host(first: Any, second: Any) -> bool:
    """Return whether two pytrees of arrays are equal, compared on the host."""
    if jax.tree.structure(first) != jax.tree.structure(second):
        return False
    pairs = zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True)
    return all(np.array_equal(np.asarray(a), np.asarray(b)) for a, b in pairs)


def prior_means_and_weights(
    names: tuple[str, ...],
    shared_size: int,
    priors: Mapping[str, Prior],
    noise: Noise | None,
    field: AbstractField | None,
    target_scale: float,
) -> tuple[Float[np.ndarray, "parameters"], Float[np.ndarray, "parameters"]]:
    """Return the prior mean and weight of every parameter; `target_scale` is the start's.

    A mean of NaN is the value of the start. The weight is one over the standard deviation; zero
    means no prior.
    """
    mean, weight = np.full(len(names), np.nan), np.zeros(len(names))
    of_size = np.array([is_size(name) for name in names])
    groups = () if field is None else field.groups
    if noise is not None:
        if len(noise.field) != len(groups):
            raise ValueError(
                f"Noise.field: expected a standard deviation for each of the field's {len(groups)} "
                f"groups, found {len(noise.field)}" + ("; give field= too" if not groups else "")
            )
        for (group, _), sigma in zip(groups, noise.field, strict=True):
            selected = parameter_mask(names, (f"{ROBOT_ERROR}.{group}",))
            mean[selected], weight[selected] = 0.0, 1.0 / sigma
        # One over infinity is a weight of zero, no prior: the poses are then free.
        pose_sigmas = np.repeat([noise.translation, noise.rotation], 3)
        weight[shared_size:] = np.tile(1.0 / pose_sigmas, (len(names) - shared_size) // 6)
    for path, prior in priors.items():
        selected = parameter_mask(names, (path,))
        rotation_names = [names[k] for k in np.flatnonzero(selected) if ".rotation." in names[k]]
        if prior.mean is not None and rotation_names:
            raise ValueError(
                f"prior on {path!r}: a rotation's prior is centred at the start; omit the mean"
            )
        weight[selected] = 1.0 / prior.std
        if prior.mean is not None:
            mean[selected] = prior.mean
        if (sizes := selected & of_size).any():
            # The parameter is the logarithm, whose standard deviation is relative.
            size = target_scale if prior.mean is None else prior.mean
            if not size > 0.0:
                raise ValueError(f"prior on {path!r}: a size is positive; found a mean of {size}")
            weight[sizes] = size / prior.std
            mean[sizes] = np.nan if prior.mean is None else np.log(size)
    return mean, weight


@compiled
def _values_at(parameters: Parameters, other: Calibration) -> Float[Array, "shared"]:
    """Return the values of another calibration; rotations as vectors from the start's."""
    # Priors on the robot's error always have a mean.
    other = dataclasses.replace(other, robot_error=parameters.start.robot_error)
    return parameters.values() + parameters.step_to(other)


def unprojectable_points(data: Dataset, start: Calibration) -> Bool[np.ndarray, "views points"]:
    """Return the visible points that cannot be projected at the start.

    Raises:
        ValueError: all points seen in a view are behind the camera or outside the lens's domain.
    """
    # Residuals of points that were seen but cannot be projected are infinite.
    residuals = np.asarray(chain_residuals(start, data.observations))
    # Component by component, because NumPy reduces an axis of two entries thirty times as slowly.
    unprojectable = ~(np.isfinite(residuals[..., 0]) & np.isfinite(residuals[..., 1]))
    visible_counts = np.asarray(data.visible).sum(axis=1)
    is_lost = (visible_counts > 0) & (unprojectable.sum(axis=1) == visible_counts)
    unprojectable_views = [data.view_ids[k] for k in np.flatnonzero(is_lost)]
    if unprojectable_views:
        raise ValueError(unprojectable_views_message(unprojectable_views))
    return np.asarray(unprojectable)


def unprojectable_views_message(views: Sequence[str]) -> str:
    """Return the error message for views without any projectable point at the start."""
    return (
        f"start: every point of view {', '.join(views)} is behind the camera or outside the "
        f"lens's domain; start nearer to the solution (fit_staged), or check the poses"
    )
