"""Names of a calibration's parameters, and the effect of a step on them.

Every number has a name, which is a path:

    camera.alpha_u  camera.lens.k1  camera_from_tool.translation.x  camera_from_tool.rotation.z
    base_from_world.translation.y  target_scale  robot_error.translation_by_position.0
    depth_bias.scale  pose_corrections.<view>.translation.x

A path selects every name that it is a prefix of; `camera.pixel_aspect`, the ratio of the focal
lengths, selects `camera.alpha_v`, in whose place it is fitted. A fit adds a step to the parameters,
except for rotations: these are multiplied from the left by the exponential of a rotation vector, in
the axes of the frame that the transform maps into (`R = exp(step) R_start`). Translations therefore
do not depend on the rotation. The parameter of the target's scale is its logarithm, so that the
scale stays positive.
"""

import difflib
from collections.abc import Callable, Iterable, Sequence
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..argument_checks import is_selected
from ..calibration import BASES, Calibration, DepthBias
from ..cameras import Camera, moved_cameras
from ..geometry import (
    host_exponentials,
    host_matrices,
    host_transforms,
    quaternion_exponentials,
    quaternion_product,
)
from ..robot_errors import RobotError
from ..runtime.array_namespace import array_namespace, as_float_array
from ..runtime.modules import HostModule, with_fields
from .pixel_aspect import alpha_v_of, aspect_of, is_alpha_v, with_aspect, without_aspect

STEP_NAMES = tuple(f"{part}.{axis}" for part in ("translation", "rotation") for axis in "xyz")
"""Names of the parameters of a transform, after the transform's own name."""

POSE_CORRECTIONS = "pose_corrections"
"""First part of the names of the views' pose corrections."""

TARGET_SCALE = "target_scale"
"""The name of the target's scale, both as a parameter and as a group of unknown size."""

DEPTH_BIAS = "depth_bias"
"""First part of the names of the bias of the depths that a camera measures."""

DEPTH_BIAS_NAMES = (f"{DEPTH_BIAS}.scale", f"{DEPTH_BIAS}.offset")
"""Names of the bias of the depths that a camera measures."""

ROBOT_ERROR = "robot_error"
"""First part of the names of the robot error field's coefficients."""


def step_names(*paths: str) -> tuple[str, ...]:
    """Return the names of the parameters of transforms, six for each path."""
    return tuple(f"{path}.{name}" for path in paths for name in STEP_NAMES)


def parameter_names(calibration: Calibration, view_ids: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the name of every parameter, in the order of the flat vector.

    Args:
        calibration: calibration whose camera, lens and mount name the parameters.
        view_ids: identifiers of the views with six pose corrections each.
    """
    camera = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(calibration.camera):
        name = f"camera{jax.tree_util.keystr(path)}"
        camera += [name] if np.ndim(leaf) == 0 else [f"{name}.{k}" for k in range(np.size(leaf))]
    transforms = step_names(*calibration.transform_names)
    bases = () if calibration.base_from_other_base is None else step_names(BASES)
    error = calibration.robot_error
    fields = [] if error is None else [f"{ROBOT_ERROR}.{name}" for name in error.field.names]
    bias = [] if calibration.depth_bias is None else list(DEPTH_BIAS_NAMES)
    shared = (*camera, *transforms, TARGET_SCALE, *fields, *bias, *bases)
    return (*shared, *correction_names(view_ids))


def is_size(name: str) -> bool:
    """Return whether a parameter is the scale of a target; of a rig, after the target's name."""
    return name.split(".")[-1] == TARGET_SCALE


def correction_names(view_ids: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the pose corrections of some views, six for each."""
    return step_names(*(f"{POSE_CORRECTIONS}.{view}" for view in view_ids))


def parameter_mask(names: Sequence[str], paths: Iterable[str]) -> Bool[np.ndarray, "parameters"]:
    """Return a mask of the parameters that the paths select.

    Raises:
        ValueError: a path selects nothing; the message suggests similar names.
    """
    selected = np.zeros(len(names), dtype=bool)
    for path in paths:
        matches = np.array([is_selected(name, (alpha_v_of(path),)) for name in names])
        if not matches.any():
            raise ValueError(_unknown_path_message(path, names))
        selected |= matches
    return selected


def _unknown_path_message(path: str, names: Sequence[str]) -> str:
    """Return the error message for a path that selects nothing, with similar names."""
    prefixes = {".".join(name.split(".")[:k]) for name in names for k in range(1, 5)}
    prefixes |= {aspect_of(name) for name in names if is_alpha_v(name)}
    prefixes = sorted(name for name in prefixes if not name.startswith(f"{POSE_CORRECTIONS}."))
    close = difflib.get_close_matches(path, prefixes, n=3, cutoff=0.4)
    hint = f"did you mean {', '.join(close)}?" if close else f"known are {', '.join(prefixes)}"
    return f"no parameter is called {path!r}; {hint}"


class Step(NamedTuple):
    """A change of the parameters, or any vector with the same layout.

    Attributes:
        shared: components of the parameters common to all views.
        per_view: six components for each view's own correction; empty without corrections.
    """

    shared: Float[Array, "shared"]
    per_view: Float[Array, "views 6"]


def host_step(shared: Float[np.ndarray, "shared"], per_view: Float[np.ndarray, "views 6"]) -> Step:
    """Return a step of NumPy arrays, which every program takes as well."""
    return Step(shared, per_view)  # pyright: ignore[reportArgumentType]


class ParameterLayout(NamedTuple):
    """The positions of the shared parameters in the flat vector, one slice for each group.

    Attributes:
        camera: pinhole parameters and lens.
        mount: step of `camera_from_mount`, translation then rotation.
        holder: step of `holder_from_world`, translation then rotation.
        target_scale: the target's scale.
        field: coefficients of the robot error field.
        depth_bias: scale and offset of depths; empty without a depth sensor.
        bases: step of `base_from_other_base`; empty for one arm.
        size: number of shared parameters.
    """

    camera: slice
    mount: slice
    holder: slice
    target_scale: slice
    field: slice
    depth_bias: slice
    bases: slice
    size: int

    @classmethod
    def of_sizes(cls, camera: int, field: int, depth_bias: int, bases: int) -> "ParameterLayout":
        """Return the layout for given numbers of parameters."""
        mount, holder, scale = camera + 6, camera + 12, camera + 13
        end = scale + field
        last = end + depth_bias
        return cls(
            slice(0, camera),
            slice(camera, mount),
            slice(mount, holder),
            slice(holder, scale),
            slice(scale, end),
            slice(end, last),
            slice(last, last + bases),
            last + bases,
        )


class Parameters(HostModule):
    """The parameters of a calibration as a flat vector, changed by steps from a start.

    Attributes:
        start: the calibration from which steps are taken.
        fits_aspect: whether the camera's second number is the ratio of its focal lengths in the
            place of alpha_v (see `pixel_aspect`); None if it is not.
    """

    start: Calibration
    fits_aspect: Bool[Any, ""] | None = None

    @property
    def with_aspect_flag(self) -> "Parameters":
        """The parameters with a flag in any case, so that either kind has the same program."""
        if self.fits_aspect is not None:
            return self
        return with_fields(self, fits_aspect=np.array(False))

    @property
    def layout(self) -> ParameterLayout:
        """The positions of the parameters common to all views."""
        camera_size = sum(np.size(leaf) for leaf in jax.tree.leaves(self.start.camera))
        error = self.start.robot_error
        bias_size = 0 if self.start.depth_bias is None else len(DEPTH_BIAS_NAMES)
        bases_size = 0 if self.start.base_from_other_base is None else len(STEP_NAMES)
        return ParameterLayout.of_sizes(
            camera_size, 0 if error is None else error.field.size, bias_size, bases_size
        )

    def values(self, xp: ModuleType = jnp) -> Float[Any, "shared"]:
        """Return the values of the start; rotations, which are steps from it, are zero.

        The value of the target's scale is its logarithm.

        Args:
            xp: `numpy` to compute on the host, where `jax.numpy` would be compiled.
        """
        start = self.start
        error, bias = start.robot_error, start.depth_bias
        transforms = [start.camera_from_mount, start.holder_from_world]
        mount, holder, *bases = (
            xp.pad(xp.asarray(transform.wxyz_xyz)[4:], (0, 3))
            for transform in (*transforms, start.base_from_other_base)
            if transform is not None
        )
        camera = xp.concatenate([xp.ravel(xp.asarray(x)) for x in jax.tree.leaves(start.camera)])
        groups = [
            camera if self.fits_aspect is None else with_aspect(camera, self.fits_aspect),
            mount,
            holder,
            xp.log(xp.asarray(start.target_scale)),
            *([] if error is None else [error.coefficients]),
            *([] if bias is None else [bias.scale, bias.offset]),
            *bases,
        ]
        return xp.concatenate([xp.ravel(xp.asarray(group)) for group in groups])

    def retract(self, step: Step) -> tuple[Calibration, Float[Array, "views 6"]]:
        """Return the calibration and the pose corrections after a step from the start."""
        start, layout, shared = self.start, self.layout, step.shared
        camera_values, rebuild = ravel_pytree(start.camera)
        if self.fits_aspect is None:
            camera = rebuild(camera_values + shared[layout.camera])
        else:
            fitted = with_aspect(camera_values, self.fits_aspect) + shared[layout.camera]
            camera = rebuild(without_aspect(fitted, self.fits_aspect))
        return self._moved(camera, shared, retract_transform), step.per_view

    def _moved(
        self, camera: Camera, shared: Array | np.ndarray, moved: Callable[[SE3, Any], SE3]
    ) -> Calibration:
        """Return the calibration after a step, by `moved` for transforms, with a moved camera."""
        start, layout, xp = self.start, self.layout, array_namespace(shared)
        error, bias, bases = start.robot_error, start.depth_bias, start.base_from_other_base
        if error is not None:
            coefficients = xp.asarray(error.coefficients) + shared[layout.field]
            error = RobotError(error.field, as_float_array(coefficients))
        if bias is not None:
            by_scale, by_offset = shared[layout.depth_bias]
            scale, offset = xp.asarray(bias.scale), xp.asarray(bias.offset)
            bias = DepthBias(scale + by_scale, offset + by_offset)
        if bases is not None:
            bases = moved(bases, shared[layout.bases])
        return Calibration(
            camera,
            moved(start.camera_from_mount, shared[layout.mount]),
            moved(start.holder_from_world, shared[layout.holder]),
            start.mount,
            xp.asarray(start.target_scale) * xp.exp(shared[layout.target_scale][0]),
            error,
            depth_bias=bias,
            base_from_other_base=bases,
        )

    def step_to(self, other: Calibration) -> Float[Array, "shared"]:
        """Return the step from the start to another calibration with the same parameters."""
        start, layout = self.start, self.layout
        # Steps are differences of values, except for rotations, whose values are zero: their steps
        # are the rotation vectors between start and end.
        step = Parameters(other, self.fits_aspect).values() - self.values()
        for place, before, after in (
            (layout.mount, start.camera_from_mount, other.camera_from_mount),
            (layout.holder, start.holder_from_world, other.holder_from_world),
            (layout.bases, start.base_from_other_base, other.base_from_other_base),
        ):
            if before is None or after is None:
                continue
            rotation = slice(place.start + 3, place.stop)
            step = step.at[rotation].set(rotation_vector_between(before, after))
        return step


def rotation_vector_between(start: SE3, end: SE3) -> Float[Array, "3"]:
    """Return the rotation vector r with `exp(r) R_start = R_end`."""
    return (end.rotation() @ start.rotation().inverse()).log()


def host_retract(start: Calibration, shared: Float[np.ndarray, "shared"]) -> Calibration:
    """Return the calibration of `Parameters(start).retract` for a step of the shared parameters.

    It is computed with NumPy, for a few steps, because compilation would take longer.
    """
    parameters = Parameters(start)
    camera = moved_cameras(start.camera, shared[parameters.layout.camera])
    assert isinstance(camera, Camera)
    return parameters._moved(camera, shared, host_retract_transform)


def host_retract_transform(start: SE3, step: Float[np.ndarray, "6"]) -> SE3:
    """Return the result of `retract_transform`, computed with NumPy."""
    matrix = host_matrices(start)
    # R = exp(step) R_start, and the translation by itself: see the module's docstring.
    rotation_alone = np.concatenate([np.zeros(3), step[3:]])
    matrix[:3, :3] = host_exponentials(rotation_alone)[:3, :3] @ matrix[:3, :3]
    matrix[:3, 3] += step[:3]
    return host_transforms(matrix)


def retract_transform(start: SE3, step: Float[Array, "6"]) -> SE3:
    """Apply a step, translation first, to a transform; both parts are changed independently."""
    turned = quaternion_product(quaternion_exponentials(step[3:]), start.wxyz_xyz[:4])
    return SE3(jnp.concatenate([turned, start.wxyz_xyz[4:] + step[:3]]))


def twist_by_step(
    matrix: Float[np.ndarray, "4 4"], turned: Float[np.ndarray, "3"] | None = None
) -> Float[np.ndarray, "6 6"]:
    """Return the twist on the left of a transform per unit of its translation and rotation step.

    Args:
        matrix: the transform.
        turned: rotation step from the start to the transform; None for a small one.
    """
    # R -> exp(r) R and t -> t + d is the twist (d + t x r, r).
    result = np.eye(6)
    result[:3, 3:] = np.cross(matrix[:3, 3], np.eye(3)).T
    if turned is not None:
        # exp(turned + r) = exp(J r) exp(turned), and exp of (v, turned) has the translation J v.
        columns = host_exponentials(np.hstack([np.eye(3), np.tile(turned, (3, 1))]))
        result[:, 3:] = result[:, 3:] @ columns[:, :3, 3].T
    return result
