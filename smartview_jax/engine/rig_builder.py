"""Build the least-squares problem of a rig: one robot, and several cameras and targets."""

from collections.abc import Mapping, Sequence
from typing import Unpack

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool

from ..argument_checks import errors_at
from ..calibration import BASES, Calibration, transform_names
from ..dataset import Rig, arms_of, is_pair, require_same_set_up
from ..robot_errors import FieldChoice, checked_field_choice
from ..runtime.array_namespace import stacked_on_device, to_device, to_device_together
from ..runtime.padding import padded_counts, repeat_last
from .abstract_problem import AbstractBuiltProblem
from .noise import Noise
from .parameters import (
    DEPTH_BIAS,
    ROBOT_ERROR,
    TARGET_SCALE,
    Parameters,
    Step,
    correction_names,
    is_size,
    parameter_names,
)
from .prepared_poses import PreparedPoses, prepare_poses
from .priors import ParameterChoice, ParameterOptions, ParameterTable, Prior
from .problem import JointProblem
from .problem_builder import (
    TYPICAL_DEPTH_BIAS,
    equal_on_host,
    prior_means_and_weights,
    unprojectable_points,
    with_depth_bias,
    with_field,
    with_known_depth_noise,
    without_region,
)
from .rig_problem import CameraGroup, RigProblem

TOOL_FROM_WORLD = transform_names("eye_to_hand")[1]
"""Name of the pose of a target on a hand, after the target's own name."""


class BuiltRig(AbstractBuiltProblem):
    """The least-squares problem of a rig together with the names of its parameters.

    Attributes:
        problem: the problem, in the parameters' own units.
        shared_names: names of the free shared parameters.
        per_view_names: names of the free parameters of single states, in order.
        noise: the assumed noise.
        starts: calibration of each camera at the start.
        cameras: names of the cameras of each group of the problem, in order.
        camera_names: names of each camera's own parameters, and of those that it shares.
    """

    problem: RigProblem
    shared_names: tuple[str, ...] = eqx.field(static=True)
    per_view_names: tuple[str, ...] = eqx.field(static=True)
    noise: Noise = eqx.field(static=True)
    starts: dict[str, Calibration]
    cameras: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    camera_names: dict[str, tuple[str, ...]] = eqx.field(static=True)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """The names of all shared parameters, free or not."""
        return _shared_names(self.camera_names)

    def without_view(self, camera: str, view: int) -> RigProblem:
        """Return the problem without the points that one camera saw in one view."""
        group = next(k for k, cameras in enumerate(self.cameras) if camera in cameras)
        row = self.cameras[group].index(camera)
        seen = np.array(self.problem.groups[group].problems.observations.visible)
        seen[row, view] = False
        return eqx.tree_at(
            lambda p: p.groups[group].problems.observations.visible,
            self.problem,
            to_device(seen),
        )


def _shared_names(camera_names: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """Return the names of the parameters of all cameras, each once."""
    return tuple(dict.fromkeys(name for names in camera_names.values() for name in names))


def build_rig(
    rig: Rig,
    starts: Mapping[str, Calibration],
    *,
    noise: Noise,
    field: FieldChoice = None,
    relative_sigmas: Mapping[str, float] | None = None,
    **parameters: Unpack[ParameterOptions],
) -> BuiltRig:
    """Build the least-squares problem of a rig.

    A camera's parameters are called `left.camera.u0` or `left.camera_from_tool.rotation.x`, with
    `left` the camera's name. A target's are called `base_from_world.translation.x` and
    `target_scale`, after the target's name and a point if there are several targets. Of a pair of
    arms the base of the target's arm is called base_left_from_base_right.translation.x.

    Args:
        rig: data sets of the cameras.
        starts: calibration of each camera; cameras of one target agree on its pose and size.
        noise: standard deviations of the pixels, of the robot's poses and of its error field.
        field: error field of the robot; None for none, and `"auto"` to hold the starts' own error.
        relative_sigmas: factor on `noise.pixel` for each camera; by default one.
        parameters: `fixed`, paths of parameters that keep the starts' values; `free`, paths to free
            that are held by default: sizes of targets; `priors`, a `Prior` by path.

    Raises:
        ValueError: starts that do not belong to the rig or hold different errors of the robot, an
            unknown path, or a start at which no point of a view can be projected.
    """
    choice = ParameterChoice.of(**parameters)
    rig.require_one_arm("build_rig")
    field = checked_field_choice(field)
    starts = _checked_starts(rig, starts, field)
    rig = _with_bases_of(rig, starts)
    camera_names = rig_parameter_names(rig, starts)
    names = _shared_names(camera_names)
    error = next(iter(starts.values())).robot_error
    prepared = prepare_poses(error, rig.command)
    place = {name: k for k, name in enumerate(names)}
    index = {
        camera: [place[name] for name in of_camera] for camera, of_camera in camera_names.items()
    }
    relative = dict.fromkeys(rig.cameras, 1.0) | dict(relative_sigmas or {})
    choice = choice._replace(priors=_priors_of_depths(starts) | choice.priors)
    table, aspects = _parameter_table(
        rig, names, choice, noise, field, holds_error=error is not None
    )
    fits_aspect = {
        camera: not aspects.isdisjoint(of_camera) for camera, of_camera in camera_names.items()
    }
    groups, cameras = _grouped(
        _with_known_depth_noise(rig, noise, relative),
        starts,
        prepared,
        index,
        relative,
        fits_aspect,
    )
    problem = RigProblem(
        groups=groups,
        command=rig.command,
        start_error=error,
        pixel_sigma=to_device(np.array(noise.pixel)),
        camera_mask=to_device(camera_mask(names)),
        **to_device_together(table.fields()),
    )
    return BuiltRig(
        problem,
        table.shared_names,
        table.per_view_names,
        noise,
        starts,
        cameras,
        camera_names,
    )


def _checked_starts(
    rig: Rig, starts: Mapping[str, Calibration], field: FieldChoice
) -> dict[str, Calibration]:
    """Return the starts with the robot's error field, and with biases where there are depths.

    Raises:
        ValueError: they do not belong to the rig, or hold different errors of the robot.
    """
    require_starts(rig, starts)
    if field == "auto":
        _require_one_robot_error(starts)
    return {
        name: with_depth_bias(with_field(without_region(starts[name]), field), data)
        for name, data in rig.cameras.items()
    }


def _parameter_table(
    rig: Rig,
    names: tuple[str, ...],
    choice: ParameterChoice,
    noise: Noise,
    field: FieldChoice,
    holds_error: bool,
) -> tuple[ParameterTable, frozenset[str]]:
    """Return all parameters of a rig, and which alpha_v have a ratio in their place.

    Args:
        rig: data sets of the cameras.
        names: names of the shared parameters.
        choice: which are free, and their priors.
        noise, field: as of `build_rig`.
        holds_error: whether the starts have an error of the robot, which `field="auto"` holds.
    """
    whole, size = (*names, *correction_names(rig.view_ids)), len(names)
    held = [name for name in names if is_size(name)]
    if field == "auto" and holds_error:
        held.append(ROBOT_ERROR)
    is_free = choice.is_free(whole, held)
    choice, aspects = choice.with_fitted_aspects(whole, is_free)
    # A state that no camera saw well enough keeps its reported pose.
    placed = np.array([len(cameras) > 0 for cameras in rig.seeing])
    is_free[size:] &= placed.repeat(6)
    fitted_field = None if field == "auto" else field
    mean, weight = prior_means_and_weights(whole, size, choice.priors, noise, fitted_field, 1.0)
    return ParameterTable(whole, size, is_free, mean, weight), aspects


def _with_known_depth_noise(rig: Rig, noise: Noise, relative_sigmas: Mapping[str, float]) -> Rig:
    """Return a rig whose depths count relative to each camera's pixel noise."""
    weighed = {
        name: with_known_depth_noise(data, noise, relative_sigmas[name])
        for name, data in rig.cameras.items()
    }
    return rig.with_cameras(weighed)


def _priors_of_depths(starts: Mapping[str, Calibration]) -> dict[str, Prior]:
    """Return the usual priors on the bias of depths, for the cameras that measure depths."""
    return {
        f"{camera}.{path}": prior
        for camera, start in starts.items()
        if start.depth_bias is not None
        for path, prior in TYPICAL_DEPTH_BIAS.items()
    }


def base_path(first: str, other: str) -> str:
    """Return the name of the transform from another arm's base to the first arm's."""
    return f"base_{first}_from_base_{other}"


def _with_bases_of(rig: Rig, starts: Mapping[str, Calibration]) -> Rig:
    """Return a rig with the bases of a pair of arms where the starts of its cameras have them.

    Raises:
        ValueError: starts of two cameras have them at different places.
    """
    if not is_pair(rig.arm_names[0]):
        return rig
    bases = {name: starts[name].base_from_other_base for name in rig.cameras}
    first, *others = bases
    placed = bases[first]
    assert placed is not None
    for name in others:
        if not equal_on_host(placed, bases[name]):
            raise ValueError(
                f"starts: the base of {' in the base of '.join(arms_of(rig.arms[name])[::-1])} is "
                f"elsewhere in {name!r} than in {first!r}"
            )
    return rig.with_cameras({name: data.with_bases(placed) for name, data in rig.cameras.items()})


def require_starts(rig: Rig, starts: Mapping[str, Calibration]) -> None:
    """Raise a ValueError unless there is one start for each camera of a rig, of its set-up."""
    if set(starts) != set(rig.cameras):
        raise ValueError(
            f"starts: expected the cameras {', '.join(rig.cameras)}, found {', '.join(starts)}"
        )
    for name, data in rig.cameras.items():
        with errors_at(f"camera {name!r}"):
            require_same_set_up("the start", starts[name], data)
        if data.hands is not None and starts[name].base_from_other_base is None:
            raise ValueError(f"starts: camera {name!r} is on one of two arms: give their bases")


def camera_mask(names: Sequence[str]) -> Bool[np.ndarray, "shared"]:
    """Return the mask of the parameters of cameras and of their depths, by their names."""
    return np.array([".camera." in name or f".{DEPTH_BIAS}." in name for name in names])


def _require_one_robot_error(starts: Mapping[str, Calibration]) -> None:
    """Raise a ValueError unless all starts have the same error of the robot, or none."""
    first, *others = starts
    expected = starts[first].robot_error
    for name in others:
        if not equal_on_host(expected, starts[name].robot_error):
            raise ValueError(
                f"starts: the robot's error in {name!r} is another than in {first!r}, but a rig "
                "has one robot; give field="
            )


def rig_parameter_names(rig: Rig, starts: Mapping[str, Calibration]) -> dict[str, tuple[str, ...]]:
    """Return what the parameters of each camera are called in a rig, by the camera's name.

    Cameras are in the order of the rig, whatever the order of the starts.

    Raises:
        ValueError: starts that do not belong to the rig.
    """
    require_starts(rig, starts)
    several = len(set(rig.targets.values())) > 1
    several_arms = len(rig.arm_names) > 1
    of_cameras: dict[str, tuple[str, ...]] = {}
    for camera, arm in rig.arms.items():
        start = starts[camera]
        target = f"{rig.targets[camera]}." if several else ""
        mount, holder = start.transform_names
        # Of several arms, the hand that a camera of a pair sees is one that others see too.
        on_hand = is_pair(arm) and several_arms
        renamed = {
            "camera": f"{camera}.camera",
            DEPTH_BIAS: f"{camera}.{DEPTH_BIAS}",
            mount: f"{camera}.{mount}",
            holder: f"{target}{TOOL_FROM_WORLD if on_hand else holder}",
            TARGET_SCALE: f"{target}{TARGET_SCALE}",
            ROBOT_ERROR: f"{arm}.{ROBOT_ERROR}" if several_arms else ROBOT_ERROR,
            BASES: base_path(*arms_of(arm)) if is_pair(arm) else BASES,
        }
        of_cameras[camera] = tuple(
            ".".join([renamed[first], *rest])
            for first, *rest in (name.split(".") for name in parameter_names(start))
        )
    return of_cameras


def _grouped(
    rig: Rig,
    starts: Mapping[str, Calibration],
    prepared: PreparedPoses | None,
    index: Mapping[str, list[int]],
    relative_sigmas: Mapping[str, float],
    fits_aspect: Mapping[str, bool],
) -> tuple[tuple[CameraGroup, ...], tuple[tuple[str, ...], ...]]:
    """Stack the cameras by kind of lens and mount; return the groups and their cameras' names."""
    by_kind: dict[object, list[str]] = {}
    for camera, start in starts.items():
        joints = rig.cameras[camera].joints is not None
        by_kind.setdefault((jax.tree.structure(start), joints), []).append(camera)
    groups = []
    for cameras in by_kind.values():
        shapes = np.array([padded_counts(*rig.cameras[c].visible.shape) for c in cameras])
        views, points = (int(count) for count in shapes.max(axis=0))
        problems, states = [], []
        for camera in cameras:
            states_of_views = np.full(views, len(rig.view_ids))
            states_of_views[: rig.cameras[camera].view_count] = rig.state_index[camera]
            states.append(states_of_views)
            problems.append(
                _camera_alone(
                    rig,
                    camera,
                    Parameters(starts[camera], np.array(fits_aspect[camera])),
                    prepared,
                    relative_sigmas[camera],
                    (views, points),
                )
            )
        places = np.array([index[camera] for camera in cameras])
        groups.append(
            CameraGroup(stacked_on_device(problems), to_device(places), to_device(np.stack(states)))
        )
    return tuple(groups), tuple(tuple(cameras) for cameras in by_kind.values())


def _camera_alone(
    rig: Rig,
    camera: str,
    parameters: Parameters,
    prepared: PreparedPoses | None,
    sigma: float,
    shape: tuple[int, int],
) -> JointProblem:
    """Return the problem of one camera, padded to a number of views and points."""
    data, (views, points) = rig.cameras[camera], shape
    unprojectable = unprojectable_points(data, parameters.start)
    visible = to_device(np.asarray(data.visible) & ~unprojectable)
    observations = eqx.tree_at(lambda o: o.visible, data.observations, visible)
    of_views = jax.tree.map(lambda x: np.asarray(x)[rig.state_index[camera]], prepared)
    size = parameters.layout.size
    nothing = Step(to_device(np.zeros(size)), to_device(np.zeros((views, 6))))
    return JointProblem(
        parameters=parameters,
        observations=observations.padded_to(views, points),
        pixel_sigma=to_device(np.array(sigma)),
        free=to_device(np.arange(size)),
        per_view_free=to_device(np.ones((views, 6), dtype=bool)),
        prior_mean=nothing,
        prior_weight=nothing,
        scale=Step(to_device(np.ones(size)), to_device(np.ones((views, 6)))),
        loss=None,
        prepared_poses=repeat_last(of_views, views),
    )
