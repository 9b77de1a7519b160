"""Build the least-squares problem of several arms from the problem of each arm alone."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float, Int

from ..argument_checks import is_selected
from ..calibration import Calibration
from ..dataset import Rig, arms_of, is_pair
from ..geometry import host_matrices, host_transforms
from ..runtime.array_namespace import to_device
from ..runtime.modules import with_fields
from .abstract_problem import AbstractBuiltProblem
from .arms_problem import ArmInRig, ArmsProblem
from .parameters import (
    POSE_CORRECTIONS,
    Step,
    host_retract_transform,
    parameter_mask,
    step_names,
)
from .pixel_aspect import alpha_v_of, aspect_of, is_aspect
from .priors import ParameterChoice, Prior
from .problem_builder import equal_on_host, prior_means_and_weights
from .rig_builder import BuiltRig, base_path, camera_mask, rig_parameter_names
from .rig_problem import RigProblem

BASE_FROM_WORLD = "base_from_world"
"""Name of the pose of a target on the table, after the target's own name."""


class BuiltArms(AbstractBuiltProblem):
    """The least-squares problem of several arms together with the names of its parameters.

    Attributes:
        problem: the problem, in the parameters' own units.
        shared_names: names of the free shared parameters.
        per_view_names: names of the free parameters of single states, in order.
        arms: the problem of each arm or pair of arms alone, by its name.
    """

    problem: ArmsProblem
    shared_names: tuple[str, ...] = eqx.field(static=True)
    per_view_names: tuple[str, ...] = eqx.field(static=True)
    arms: dict[str, BuiltRig]


def choices_of_arms(
    rig: Rig,
    starts: Mapping[str, Calibration],
    choice: ParameterChoice,
) -> dict[str, ParameterChoice]:
    """Return the choice of each arm's parameters, in the names of its rig alone.

    The pose of a target that several arms see is a parameter of the first arm alone.

    Args:
        rig: data sets of all arms.
        starts: calibration of each camera.
        choice: as for `build_rig`; with several arms in the names of `build_arms`.

    Raises:
        ValueError: a path that selects nothing, or a base that is held, or has a prior without a
            mean.
    """
    if len(rig.arm_names) == 1:
        return {rig.arm_names[0]: choice}
    names = {arm: _names_of_arm(rig, arm, starts) for arm in rig.arm_names}
    for arm in rig.arm_names:
        moved = {name for pose in _moved_poses(rig, arm, starts).values() for name in pose}
        names[arm] = {alone: name for alone, name in names[arm].items() if alone not in moved}
    bases = [base_path(rig.robot_names[0], arm) for arm in rig.robot_names[1:]]
    of_bases = step_names(*bases)
    for path in choice.fixed:
        if path.partition(".")[0] in bases:
            raise ValueError(f"fixed: {path!r}: a base has no start; give a prior with a mean")
    for path, prior in choice.priors.items():
        if path.partition(".")[0] in bases and prior.mean is None:
            raise ValueError(f"prior on {path!r}: a base has no start; give the mean")
    everything = [*of_bases, *(name for of_arm in names.values() for name in of_arm.values())]

    def own_paths(arm: str, path: str) -> list[str]:
        """Return the arm's own names of the parameters that a path selects."""
        first, _, rest = path.partition(".")
        if first in rig.arm_names:
            # The coefficients of its error are not known before the views are compared.
            return [rest] if first == arm else []
        parameter_mask(everything, (path,))
        if is_aspect(path):
            alpha_v = alpha_v_of(path)
            return [aspect_of(alone) for alone, name in names[arm].items() if name == alpha_v]
        return [alone for alone, name in names[arm].items() if is_selected(name, (path,))]

    return {
        arm: ParameterChoice(
            tuple(alone for path in choice.fixed for alone in own_paths(arm, path)),
            tuple(alone for path in choice.free for alone in own_paths(arm, path)),
            {
                alone: prior
                for path, prior in choice.priors.items()
                for alone in own_paths(arm, path)
            },
        )
        for arm in rig.arm_names
    }


def build_arms(
    rig: Rig,
    arms: Mapping[str, tuple[BuiltRig, Step]],
    priors: Mapping[str, Prior] | None = None,
) -> tuple[BuiltArms, Step]:
    """Build the least-squares problem of several arms from the solved problem of each.

    The parameters of cameras and targets have the names of `build_rig`; a target that several arms
    see has its pose in the base of the first arm. An arm's errors are called `left.robot_error...`
    and `pose_corrections.left/<view>...`, with `left` the arm's name (`left+right` of a pair), and
    the base of every other arm is called base_left_from_base_right.translation.x.

    Args:
        rig: data sets of all arms.
        arms: problem of each arm and pair of arms, with its noise as priors, and its solution.
        priors: priors by path; only priors on bases are used, since the arms' problems have the
            others.

    Returns:
        The problem, and a step near its solution.
    """
    starts = {name: start for built, _ in arms.values() for name, start in built.starts.items()}
    _require_one_pose_on_hands(rig, starts)
    parts = [_Part.of(rig, arm, starts, *arms[arm]) for arm in rig.arm_names]
    first, *others = rig.robot_names
    bases = {arm: step_names(base_path(first, arm)) for arm in others}
    of_arms = (name for part in parts for name in part.names_of_all)
    of_bases = [name for of_base in bases.values() for name in of_base]
    names = tuple(dict.fromkeys((*of_arms, *of_bases)))
    place = {name: k for k, name in enumerate(names)}

    shared = _shared_parameters(parts, place)
    mean, weight = _with_priors_of_bases(names, shared, others, first, priors or {})

    problems = [part.built.problem for part in parts]
    per_view_free = np.concatenate([np.asarray(p.per_view_free) for p in problems])
    means, weights = (
        np.concatenate([np.asarray(step.per_view) for step in of_arms])
        for of_arms in ([p.prior_mean for p in problems], [p.prior_weight for p in problems])
    )
    problem = ArmsProblem(
        arms=_placed(parts, place, bases, rig.robot_names),
        camera_mask=to_device(camera_mask(names)),
        pixel_sigma=to_device(np.array(1.0)),
        free=to_device(np.flatnonzero(shared.free)),
        per_view_free=to_device(per_view_free),
        prior_mean=Step(to_device(mean), to_device(means)),
        prior_weight=Step(to_device(weight), to_device(weights)),
        scale=Step(to_device(np.ones(shared.free.sum())), to_device(np.ones(per_view_free.shape))),
    )
    corrections = np.concatenate([np.asarray(arms[part.arm][1].per_view) for part in parts])
    built = BuiltArms(
        problem,
        tuple(names[k] for k in np.flatnonzero(shared.free)),
        tuple(
            name.replace(f"{POSE_CORRECTIONS}.", f"{POSE_CORRECTIONS}.{part.arm}/", 1)
            for part in parts
            for name in part.built.per_view_names
        ),
        {part.arm: part.built for part in parts},
    )
    return built, Step(to_device(shared.step[shared.free]), to_device(corrections))


def _require_one_pose_on_hands(rig: Rig, starts: Mapping[str, Calibration]) -> None:
    """Raise a ValueError unless all cameras that see a target on a hand start from one pose of it.

    Raises:
        ValueError: the message names two cameras.
    """
    first: dict[str, str] = {}
    for camera, start in starts.items():
        if start.mount != "eye_in_hand":
            other = first.setdefault(rig.targets[camera], camera)
            if not equal_on_host(start.holder_from_world, starts[other].holder_from_world):
                raise ValueError(
                    f"starts: the target {rig.targets[camera]!r} on a hand is elsewhere in "
                    f"{camera!r} than in {other!r}"
                )


class _Shared(NamedTuple):
    """The shared parameters of all arms.

    Attributes:
        step: solution of the arms' own problems; zero for held ones, bases, and poses of targets
            that the first arm does not see.
        free: mask of the free ones.
        mean, weight: mean and weight of the arms' priors.
    """

    step: Float[np.ndarray, "shared"]
    free: Bool[np.ndarray, "shared"]
    mean: Float[np.ndarray, "shared"]
    weight: Float[np.ndarray, "shared"]


def _shared_parameters(parts: Sequence["_Part"], place: Mapping[str, int]) -> _Shared:
    """Return the shared parameters of all arms, with `place` the index of each name."""
    size = len(place)
    known, free = np.zeros(size, dtype=bool), np.zeros(size, dtype=bool)
    step, mean, weight = np.zeros(size), np.full(size, np.nan), np.zeros(size)
    for part in parts:
        kept = ~part.is_moved
        of_all = np.array(list(part.names.values()))[kept]
        index = np.array([place[name] for name in of_all])
        own_free, own_step = part.is_free[kept], part.step[kept]
        own_mean, own_weight = (
            np.asarray(values.shared)[kept]
            for values in (part.built.problem.prior_mean, part.built.problem.prior_weight)
        )
        # Only the size of a common target, and its pose on a hand, belong to several parts. They
        # have the weakest of their priors, since the pixels of all are in the fit.
        weaker = own_free & (~free[index] | (own_weight < weight[index]))
        taken = weaker | ~known[index]
        for values, of_arm in ((step, own_step), (mean, own_mean), (weight, own_weight)):
            values[index[taken]] = of_arm[taken]
        free[index] |= own_free
        known[index] = True
    # Bases, and poses of targets that the first arm does not see, are free.
    return _Shared(step, free | ~known, mean, weight)


def _with_priors_of_bases(
    names: tuple[str, ...],
    shared: _Shared,
    others: Sequence[str],
    first: str,
    priors: Mapping[str, Prior],
) -> tuple[Float[np.ndarray, "shared"], Float[np.ndarray, "shared"]]:
    """Return the means and weights of all priors, including the given priors on bases."""
    paths = {base_path(first, arm) for arm in others}
    given = {path: prior for path, prior in priors.items() if path.split(".")[0] in paths}
    mean, weight = prior_means_and_weights(names, len(names), given, None, None, 1.0)
    return np.where(weight > 0.0, mean, shared.mean), shared.weight + weight


class _Part(NamedTuple):
    """An arm or a pair of arms with its solved problem and the names of its parameters.

    Its *linked poses* connect it with other parts: the poses in the arm's base of targets on the
    table that another arm sees too; of a pair, the base of the target's arm in the camera's.

    Attributes:
        arm: name of the arm, or of the pair.
        built: its problem alone.
        step: solution of this problem for all shared parameters, zero for held ones.
        names: what each parameter of the arm is called among the parameters of all arms.
        starts: linked poses from which the steps are taken, by the target or the target's arm.
        poses: the arm's own names of the linked poses.
        moved: linked poses that are no parameters: they follow from poses in the first base.
    """

    arm: str
    built: BuiltRig
    step: Float[np.ndarray, "own"]
    names: dict[str, str]
    starts: dict[str, SE3]
    poses: dict[str, tuple[str, ...]]
    moved: dict[str, tuple[str, ...]]

    @classmethod
    def of(
        cls, rig: Rig, arm: str, starts: Mapping[str, Calibration], built: BuiltRig, z: Step
    ) -> "_Part":
        """Return an arm of a rig, or a pair of arms."""
        names = _names_of_arm(rig, arm, starts)
        step = np.zeros(len(names))
        step[np.asarray(built.problem.free)] = np.asarray(z.shared)
        poses, own_starts = _linked_poses(rig, arm, starts), {}
        for camera in rig.of_arm(arm).cameras:
            bases = starts[camera].base_from_other_base
            if bases is None:
                own_starts[rig.targets[camera]] = starts[camera].holder_from_world
            else:
                own_starts[arms_of(arm)[1]] = bases
        return cls(
            arm,
            built,
            step,
            names,
            {name: own_starts[name] for name in poses},
            poses,
            _moved_poses(rig, arm, starts),
        )

    @property
    def is_free(self) -> Bool[np.ndarray, "own"]:
        """Mask of the free shared parameters."""
        return np.isin(np.arange(len(self.names)), np.asarray(self.built.problem.free))

    @property
    def is_moved(self) -> Bool[np.ndarray, "own"]:
        """Mask of the linked poses that are no parameters of all arms."""
        return np.isin(list(self.names), [name for group in self.moved.values() for name in group])

    @property
    def names_of_all(self) -> list[str]:
        """The part's names among all arms' parameters, without a pair's bases."""
        is_kept = ~self.is_moved if is_pair(self.arm) else np.ones(len(self.names), dtype=bool)
        return [name for name, kept in zip(self.names.values(), is_kept, strict=True) if kept]

    def indices(self, linked: str) -> Int[np.ndarray, "6"]:
        """Return the indices of a linked pose among the arm's own parameters."""
        all_names = list(self.names)
        return np.array([all_names.index(name) for name in self.poses[linked]])

    def solved_pose(self, linked: str) -> Float[np.ndarray, "4 4"]:
        """Return a linked pose by the arm's own solution."""
        return host_matrices(
            host_retract_transform(self.starts[linked], self.step[self.indices(linked)])
        )


def _names_of_arm(rig: Rig, arm: str, starts: Mapping[str, Calibration]) -> dict[str, str]:
    """Return what each parameter of an arm is called among the parameters of all arms."""
    of_all, part = rig_parameter_names(rig, starts), rig.of_arm(arm)
    names_by_camera = rig_parameter_names(part, {camera: starts[camera] for camera in part.cameras})
    return {
        name: given
        for camera, names in names_by_camera.items()
        for name, given in zip(names, of_all[camera], strict=True)
    }


def _linked_poses(
    rig: Rig, arm: str, starts: Mapping[str, Calibration]
) -> dict[str, tuple[str, ...]]:
    """Return the parameters of each linked pose, by its target, or by a pair's other arm."""
    if is_pair(arm):
        first, other = arms_of(arm)
        return {other: step_names(base_path(first, other))}
    others = {rig.targets[camera] for camera, name in rig.arms.items() if name != arm}
    part = rig.of_arm(arm)
    names = rig_parameter_names(part, {camera: starts[camera] for camera in part.cameras})
    return {
        target: tuple(name for name in names[camera] if BASE_FROM_WORLD in name.split("."))
        for camera, target in part.targets.items()
        if target in others and part.cameras[camera].mount == "eye_in_hand"
    }


def _moved_poses(
    rig: Rig, arm: str, starts: Mapping[str, Calibration]
) -> dict[str, tuple[str, ...]]:
    """Return the linked poses of an arm that are not in the base of the first arm."""
    return {} if arm == rig.robot_names[0] else _linked_poses(rig, arm, starts)


def _poses_in_first_base(
    parts: Sequence[_Part], robots: Sequence[str]
) -> tuple[dict[str, Float[np.ndarray, "4 4"]], dict[str, Float[np.ndarray, "4 4"]]]:
    """Return the base of each arm and the pose of each common target in the base of the first arm.

    They follow from the arms' own solutions, one arm after the other.
    """
    bases: dict[str, Float[np.ndarray, "4 4"]] = {robots[0]: np.eye(4)}
    targets: dict[str, Float[np.ndarray, "4 4"]] = {}
    # The arms are connected: each pass places one of the missing bases, and the last one targets.
    for part in [*parts] * len(robots):
        first, *others = arms_of(part.arm)
        if others:
            (other,), between = others, part.solved_pose(others[0])
            if first in bases:
                bases.setdefault(other, bases[first] @ between)
            elif other in bases:
                bases[first] = bases[other] @ np.linalg.inv(between)
            continue
        known = [target for target in part.poses if target in targets]
        if first not in bases and known:
            bases[first] = targets[known[0]] @ np.linalg.inv(part.solved_pose(known[0]))
        if first in bases:
            for target in part.poses:
                targets.setdefault(target, bases[first] @ part.solved_pose(target))
    return bases, targets


def _placed(
    parts: Sequence[_Part],
    place: Mapping[str, int],
    names_of_bases: Mapping[str, tuple[str, ...]],
    robots: Sequence[str],
) -> tuple[ArmInRig, ...]:
    """Return the arms with the bases and the common targets where the arms' solutions are.

    A target that the first arm sees begins where its own start is.
    """
    bases, targets = _poses_in_first_base(parts, robots)
    # The first base is no parameter: its indices are after the last one.
    columns = {robots[0]: np.arange(len(place), len(place) + 6)} | {
        arm: np.array([place[name] for name in names]) for arm, names in names_of_bases.items()
    }
    if parts[0].arm == robots[0]:
        targets |= {target: host_matrices(start) for target, start in parts[0].starts.items()}
    members = []
    for part in parts:
        moved = list(part.moved)
        rows = np.array([part.indices(name) for name in moved], dtype=int).reshape(-1, 6)
        index = np.array([place.get(name, -1) for name in part.names.values()])
        if is_pair(part.arm):
            index[rows] = [columns[other] for other in moved]
        firsts = bases if is_pair(part.arm) else targets
        members.append(
            ArmInRig(
                problem=_with_all_free(part.built.problem),
                parameter_index=to_device(index),
                base_index=to_device(columns[arms_of(part.arm)[0]]),
                linked_poses=to_device(rows),
                first_base_from_base=host_transforms(bases[arms_of(part.arm)[0]]),
                first_base_from_linked=host_transforms(
                    np.array([firsts[name] for name in moved]).reshape(-1, 4, 4)
                ),
                base_from_linked=host_transforms(
                    np.array([host_matrices(part.starts[n]) for n in moved]).reshape(-1, 4, 4)
                ),
            )
        )
    return tuple(members)


def _with_all_free(problem: RigProblem) -> RigProblem:
    """Return the problem of one arm with all its shared parameters free, in their own units."""
    size = problem.parameter_count
    scale = Step(to_device(np.ones(size)), problem.scale.per_view)
    return with_fields(problem, free=to_device(np.arange(size)), scale=scale)
